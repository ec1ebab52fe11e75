"""Cameras that exist."""
