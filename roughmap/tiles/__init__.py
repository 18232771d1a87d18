"""Where cells live: the table of tiles, their memory, and their ways out of it and back."""
