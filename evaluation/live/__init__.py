"""`slipcar live`: a page on which worlds are dragged and plans follow."""
