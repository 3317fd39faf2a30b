"""The offscreen camera: rendering, lens, exposure, noise, degradations."""
