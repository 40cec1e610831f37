"""The steps of runs, by their products: photographs, calibrations, appearances. `costs` estimates their times."""
