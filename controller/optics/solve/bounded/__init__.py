"""Bounded least-squares solvers. Entries: `solver.solve_bounded`, the global one (paper eqs 2 and 3), and
`regions.solve_regions`, the paper's own by regions (eq. 7).
"""
