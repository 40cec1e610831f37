# %% A dataset of `velatura export --format dataset`, read without Velatura
import hashlib
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import OpenEXR

FOLDER = Path("dataset")
for line in (FOLDER / "SHA256SUMS").read_text().splitlines():
    digest, name = line.split("  ", 1)
    assert hashlib.sha256((FOLDER / name).read_bytes()).hexdigest() == digest, name
index = json.loads((FOLDER / "index.json").read_text())
print(f"{len(index['photographs'])} photographs, {len(index['appearances'])} appearances")


def read_exr(name):
    with OpenEXR.File(str(FOLDER / name)) as file:
        return next(iter(file.channels().values())).pixels[..., :3].astype(np.float32)


# %% A photograph as light, in full scales per second
first = index["photographs"][0]
light = read_exr(first["file"]) / first["exposure_s"]

# %% Where the geometry puts the points of the object, against where the camera saw the projector's pixels
geometry = np.load(FOLDER / "calibration/geometry.npz")
views = json.loads((FOLDER / "calibration/geometry.json").read_text())["projectors"]
for projector in index["projectors"]:
    pixels = np.load(FOLDER / f"calibration/pixels-{projector['stem']}.npz")
    view = {key: np.array(value) for key, value in views[projector["name"]].items()}
    local = geometry["points_m"] @ view["rotation"].T + view["translation_m"]
    flat = local[..., :2] / local[..., 2:]
    k1, k2, p1, p2 = (*view["distortion"], 0, 0)[:4]
    r2, product = np.sum(flat**2, axis=-1, keepdims=True), 2 * np.prod(flat, axis=-1, keepdims=True)
    bent = flat * (1 + k1 * r2 + k2 * r2**2) + product * (p1, p2) + (r2 + 2 * flat**2) * (p2, p1)
    px = bent @ view["matrix"][:2, :2].T + view["matrix"][:2, 2]
    off = np.linalg.norm(px - pixels["projector_px"], axis=-1)[pixels["seen"]]
    print(f"{projector['name']}: the median distance is {np.nanmedian(off):.3f} px")

# %% A picture of them, and of a result
figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.5))
left.imshow(np.clip(light / np.nanpercentile(light, 99), 0, 1) ** (1 / 2.2))
left.set_title(f"{first['kind']}: {first['name']}")
middle.imshow(geometry["points_m"][..., 2])
middle.set_title("depth in metres")
if index["appearances"]:
    appearance = index["appearances"][0]
    frame = plt.imread(FOLDER / next(iter(appearance["frames"].values())))
    right.imshow(frame)
    right.set_title(appearance["name"])
    with OpenEXR.File(str(FOLDER / appearance["target"])) as file:
        target = file.channels()["RGBA"].pixels
    print(f"{(target[..., 3] > 0).mean():.0%} of the target's pixels can be reached")
figure.savefig("dataset.png")
