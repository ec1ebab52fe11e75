"""The doctor: looks at everything a cell needs, and says for each thing what is wrong and what to do.

It moves nothing, and changes nothing but what every opening of the devices puts right in their settings. Each check
is a small function of a `Case`; `examine` calls them all.
"""
