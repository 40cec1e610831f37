"""Compensation images from a transport and a target. Entry: `request.solve_appearance` for one appearance,
`appearance.solve_base` for the base.
"""
