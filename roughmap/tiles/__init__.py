"""Storage of cells: the table of tiles, their memory, and how they leave it and return."""
