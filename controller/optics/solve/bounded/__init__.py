"""The bounded least-squares solver (paper eqs 2 and 3). Entry: `solver.solve_bounded`."""
