"""`turf`: wide mown grass: a sports ground, a golf course or an airfield."""
