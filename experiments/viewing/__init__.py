"""The Rerun viewer: its processes, a flight in progress, two flights in one recording."""
