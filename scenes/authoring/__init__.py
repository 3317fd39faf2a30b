"""Building blocks of the scene generators: terrain, textures, light, water, roads, plots."""
