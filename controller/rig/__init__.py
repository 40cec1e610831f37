"""The devices that a run uses together (`rig.Rig`): lamps kept within their rules (`lamp_guard`), mains, ambient
light, key panel.
"""
