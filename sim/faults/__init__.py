"""Scheduled faults: their schedule, and their effects on messages, rotors, mounts and air."""
