"""The PID cascade that turns an estimate and a setpoint into rotor speeds."""
