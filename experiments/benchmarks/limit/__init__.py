"""``touchdown bench limit``: the Cramér-Rao bound of the position error of a logged survey."""
