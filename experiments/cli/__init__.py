"""Commands: each parses its options, calls one function of a package and prints."""
