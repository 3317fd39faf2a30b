"""Classification networks in plain torch. `registry` lists them without loading torch."""
