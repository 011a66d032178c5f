"""Sensor messages, their calibration and their synchronisation."""
