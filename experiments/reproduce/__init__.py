"""`touchdown reproduce`: every table and figure of the paper, part by part."""
