"""Logs of RGB-D and IMU recordings: records, MCAP reader and writer, converters, simulation."""
