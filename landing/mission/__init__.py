"""The landing state machine: phases, trajectories, descent, touchdown."""
