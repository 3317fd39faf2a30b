"""An exactly level patchwork of lawns and fields."""
