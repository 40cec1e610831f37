# %% Develop RAW photographs of one scene, taken with several exposures
from pathlib import Path

from controller import api

exposures_s = {"short.dng": 1 / 60, "middle.dng": 1 / 15, "long.dng": 1 / 4}
photographs = [api.develop(Path("bracket") / name) for name in exposures_s]
for name, photograph in zip(exposures_s, photographs, strict=True):
    print(f"{name}: {100 * photograph.saturated.mean():.1f} % saturated")

# %% Merge them to one image without a ceiling, in full scales per second
merged = api.merge_brackets([photograph.image for photograph in photographs], list(exposures_s.values()))
api.export("scene.exr", merged.radiance)
