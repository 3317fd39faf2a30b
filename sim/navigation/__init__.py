"""Navigation sensors: GPS receiver, barometer, magnetometer, rangefinder; rates and delays."""
