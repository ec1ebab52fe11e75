"""Localization: from an outline in pixels to a pose and a size in millimetres on the table."""
