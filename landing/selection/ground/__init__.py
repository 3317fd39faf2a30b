"""The ground of an elevation map: rasters, low plants, cells on which a touchdown is safe."""
