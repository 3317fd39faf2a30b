"""Site selection on maps: its steps, a reference, times, and choices against the truth."""
