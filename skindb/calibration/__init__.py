"""Calibration of cameras, lights and probe, and the radiometry that ingest shares with it."""
