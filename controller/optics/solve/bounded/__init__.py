"""The global bounded least-squares solve (paper eqs 2 and 3). Entry: `solver.solve_bounded`."""
