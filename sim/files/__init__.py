"""Files from other people: how they are opened, inflated, and tried by libraries in C.

It depends on nothing of ours, and is open to all folders.
"""
