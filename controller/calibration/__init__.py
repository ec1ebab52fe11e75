"""Calibration: from pictures of printed boards and of the arm to millimetres, with a stated uncertainty.

boards (what is printed and found) -> camera (the lens) -> table (where the camera is) -> arm (where the
arm is and how its joints are mounted); `store` keeps the results in files, `guided` runs the procedure.
"""
