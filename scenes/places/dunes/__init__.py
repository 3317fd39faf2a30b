"""Sand dunes and the flats between them, with scrub and rock outcrops."""
