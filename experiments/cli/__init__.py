"""Commands: each parses its options, calls one function of a room and prints."""
