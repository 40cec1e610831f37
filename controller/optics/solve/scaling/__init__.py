"""Base times scale at interactive speed (paper eqs 4 to 6). Entry: `stage_maps`, `interactive`; `dither` makes
device values.
"""
