"""Ground classification: what kind of ground a picture from the air shows."""
