"""The offscreen camera: sensor, OpenGL rendering, lens, exposure, noise, degradations."""
