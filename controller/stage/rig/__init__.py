"""The devices that a run uses together (`rig.Rig`): lamps under their rules (`lamp_guard`), mains, ambient
light, key panel.
"""
