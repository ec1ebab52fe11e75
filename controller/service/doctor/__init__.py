"""The doctor: looks at everything a cell needs, and says for each thing what is wrong and what to do.

It changes nothing and moves nothing. Each check is a small function of a `Case`; `examine` calls them all.
"""
