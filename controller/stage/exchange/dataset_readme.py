"""The README of a research dataset."""

from __future__ import annotations

from typing import Final

README: Final = """# A Velatura run as a dataset

Everything here opens with numpy (`.npz`, without pickle), OpenEXR (`.exr`), matplotlib (`.png`) and a JSON reader.
`SHA256SUMS` lists all other files: `sha256sum -c SHA256SUMS`. `index.json` lists photographs, projectors and results.

Light is linear everywhere. Pictures are (rows, columns, 3), red, green, blue. Positions are x, y in pixels, and the
centre of the first pixel is (0, 0). Lengths are metres, in the camera's frame: x right, y down, z forward.

## Photographs

| folder | what |
|---|---|
| `originals/KIND/` | the camera's own files |
| `photographs/KIND/` | the same as linear light: 0 black level, 1 full scale, NaN saturated; 16-bit floats |

KIND is the kind of the photographs, and the projector that was lit. In `index.json` each has its pattern (`name`), its
`projector` (null: none or all), its `exposure_s` (seconds, as measured), its `file` and its `original`. A picture
divided by its exposure is in full scales per second, the unit of all other light here.

`gray-x-N` and `gray-y-N` are Gray code of cells 12 projector pixels wide, coarsest bit first. `phase-*` are sinusoids
of 24 pixels in three steps; `blur-*` are finer ones. With few photographs (`patterns-NAME.json`), `gray-rgb-N` hold
three bits each, and sinusoids have two steps, a quarter of a period apart.
`mosaic-*` are coloured tiles. `random-*` pictures only check the
result.

## Calibration

A projector's name stands for NAME.

| file | arrays |
|---|---|
| `geometry.npz` | `points_m`, `normals` (camera rows, columns, 3), NaN unknown; `sigma_m` along the camera's ray |
| `geometry.json` | `camera` and `projectors`: `matrix`, `distortion` (k1, k2), `rotation`, `translation_m`, `size_px` |
| `radiometry-NAME.npz` | `white` of this projector alone, `black`; `response` (3, 256); `mixing` |
| `pixels-NAME.npz` | `projector_px` of camera pixels where `seen`; of projector pixels `centre_px`, `covariance_px2` |
| | `colours_px` (3, 2): how far red, green and blue lie to the right and below, where they do not lie on each other |
| `dots-NAME.npz`, `edges-NAME.npz` | the same spots, measured by dots, where the run has them |
| `camera.npz` | measurements of the camera |
| `indirect-NAME.npz` | light that came by way of other surfaces, where it was measured |
| `exposure.json`, `delay.json` | seconds: exposures of the photographs, delay of the projectors' pictures |
| `verification.json`, `verification.npz` | the grade: the error of a prediction for pictures that were not used |

A point X of the object lies in a view at K d([R | t] X), with d(x) = x (1 + k1 r^2 + k2 r^4) in normalised coordinates.

## Appearances

`appearances/NAME/target.exr` is the light that was wanted (alpha 1: it could be reached). `frame-PROJECTOR.png` is what
the projector showed, 8-bit device values. `photograph.exr` is the result in HDR, where one was taken. `figures` in
`index.json` are those of the solve.
"""
