# %% What to show first: the patterns that need no response, as PNG pictures
import numpy as np

from controller import api

for name, frame in api.draw_patterns((64, 48)).items():
    api.export(f"show/{name}.png", frame)

# %% Photographs of a projector's patterns: photographs/captures.toml says which file is which
captures = api.read_captures("photographs")

# %% The projector's response, with which the other patterns are drawn
radiometry = api.measure_response(captures)
for name, frame in api.draw_patterns(captures.projector_px, response=radiometry.response).items():
    api.export(f"show/{name}.png", frame)

# %% Where each camera pixel looks, and where each projector pixel lands
correspondence = api.decode(captures)
metapixels = api.fit_metapixels(captures, correspondence).metapixels
print(f"{correspondence.valid.mean():.0%} of the camera pixels, {metapixels.valid.mean():.0%} of the projector's")

# %% All of it at once, for one projector or several, and the light transport
calibration = api.calibrate({"left": captures})
transport = api.build_transport(calibration)
predicted = transport.forward([np.full((*transport.sizes[0], 3), 0.5, np.float32)]) + calibration.black

# %% The same where surfaces light each other: direct and indirect light told apart by the same photographs
calibration = api.calibrate({"left": captures}, indirect=True)
transport = api.build_transport(calibration)
indirect = api.indirect_light(calibration, transport)
target = api.reachable_target(transport, np.full_like(calibration.black, 0.5), calibration.black, indirect=indirect)
direct = transport.forward(api.solve(transport, target.direct, calibration.black).frames)
if indirect is not None:
    thrown_back = indirect.forward(direct)
    print(f"{thrown_back.sum() / (direct.sum() + thrown_back.sum()):.1%} of the light comes by way of other surfaces")

# %% What other programs may read
api.export("calibration.npz", {"centre_px": metapixels.centre_px, "predicted": predicted})
