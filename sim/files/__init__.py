"""Files from other people: how they are opened, and read in a process with limits.

It depends on nothing of ours, and is open to all folders.
"""
