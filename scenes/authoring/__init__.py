"""What scene generators share: terrain, textures, light, roads, plots."""
