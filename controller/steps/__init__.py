"""The steps of runs, by what they produce: photographs, calibrations, appearances. `costs` says how long each
takes.
"""
