"""The detector of people: its rendered images, its training, its figures."""
