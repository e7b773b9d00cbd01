"""Drawing with pygame: scenes, tiles, and what moves in them."""
