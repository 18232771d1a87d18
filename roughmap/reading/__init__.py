"""Reading a map: frozen maps, coarser levels, layers, terrain and regions."""
