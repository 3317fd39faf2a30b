"""The schedule of faults, and what they do to messages, rotors, mounts and air."""
