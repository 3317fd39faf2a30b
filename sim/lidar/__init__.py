"""The ray-cast LIDAR: scan patterns, ray casting, link budget, noise."""
