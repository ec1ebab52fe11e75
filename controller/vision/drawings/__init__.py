"""Outlines of parts from drawings: DXF and SVG files, in millimetres."""
