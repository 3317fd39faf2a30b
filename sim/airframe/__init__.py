"""The vehicle: rotors, battery, contacts, start on the ground."""
