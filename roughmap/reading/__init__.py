"""What the map says: frozen readings, levels, layers, terrain, regions."""
