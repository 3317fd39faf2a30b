"""What a flight writes while it flies."""
