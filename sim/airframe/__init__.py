"""The vehicle's physics: MJCF parameters, rotors, battery, contacts, start on the ground."""
