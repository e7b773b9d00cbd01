"""What is shown of results: tables, texts, files, and one page of all."""
