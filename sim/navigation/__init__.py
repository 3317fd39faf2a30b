"""The small sensors: GPS receiver, barometer, magnetometer, rangefinder, their rates and delays."""
