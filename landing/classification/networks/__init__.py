"""Networks that tell ground apart, in plain torch. `registry` names them without loading torch."""
