"""Motion: where the tool goes, how fast, and whether it may; nothing here touches hardware.

Conventions: lengths mm, angles rad. `base` is the arm's frame, z up from the table's surface, x ahead.
`tool` has its origin at the grasp point, x along the fingers (the pointing direction) and y along the
closing direction of the jaws. pitch is the angle of tool x below the horizon: pi/2 points straight down.
"""
