"""The steps from photographs to a calibration: radiometry, correspondences and metapixels, geometry, grade."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, replace
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.config.models import PoseTable
from controller.core.arrays import Float64, FloatImage
from controller.core.errors import CalibrationError, TroubleCode
from controller.optics.calibrate.correspondence.captures import completed
from controller.optics.calibrate.correspondence.colour_alignment import (
    ColourPlaces,
    colour_shifts,
    colour_sizes,
    colours_apart,
    fringed,
    misaligned,
)
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.geometry.lenses import bent
from controller.optics.calibrate.geometry.self_calibration import first_poses, jumps, one_projector
from controller.optics.calibrate.geometry.shape import AskedShape, FoundShape, find_shape, shape_sentence
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.calibrate.geometry.view_poses import FEWEST_POINTS, SeenStage, join_views
from controller.optics.calibrate.metapixels.from_phase import fit_pixels
from controller.optics.calibrate.photometry.glare import spread_by_lens
from controller.optics.calibrate.photometry.projector_glare import DarkPart, lens_veils, projector_glare
from controller.optics.calibrate.photometry.radiometry import measure_radiometry, white_segment
from controller.optics.calibrate.values import Correspondence, Pinhole
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.raw import CAMERA_BLUR_PX, SRGB_TO_XYZ
from controller.optics.transport.indirect.stripes import stride_of, stripe_parts, thinned
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import merge_photographs, read_black, read_captures, read_correspondence
from controller.stage.artefacts.geometry import (
    camera_px,
    has_geometry,
    read_geometry,
    read_shape,
    write_geometry,
    write_view_pose,
)
from controller.stage.artefacts.kinds import StepKind, of_projectors
from controller.stage.artefacts.pattern_plans import PhotographOptions, PlanUsed
from controller.stage.artefacts.photographs import Developed, TakenPhotograph, light_of, noise_of, white_bracket
from controller.stage.artefacts.projectors import Light, PixelFigures, Pixels, read_metapixels, write_radiometry_figures
from controller.stage.artefacts.views import view_folders
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps import costs
from controller.stage.steps.calibrate.indirect import indirect_step
from controller.stage.steps.capture.camera import camera_step
from controller.stage.steps.capture.patterns import capture_steps, code_step, light_step
from controller.stage.steps.troubles import tell, tell_all
from hal.notices import Level, Notice


def calibration_steps(
    rig: Rig,
    prior: CameraPrior,
    *,
    longest_exposure_s: float,
    options: PhotographOptions | None = None,
    shape: AskedShape = "auto",
) -> list[Step]:
    """All steps from the first photograph to metapixels and geometry.

    Raises CalibrationError("one-projector") if a surface is asked for that it can't measure.
    """
    if shape == "surface" and len(rig.projectors) < 2:
        raise one_projector()
    steps = capture_steps(rig, longest_exposure_s=longest_exposure_s)
    # The camera and all responses are measured beside photographs, so that no photograph waits for them.
    steps.append(camera_step(rig))
    names = [projector.name for projector in rig.projectors]
    several = rig.seat is not None or not rig.is_first
    for projector in rig.projectors:
        steps.append(light_step(rig, projector, options))
        steps.append(_radiometry_step(projector, several=several))
    for number, projector in enumerate(rig.projectors):
        code = code_step(rig, projector, options)
        # What is asked for may be refused, so nothing more is photographed before that is known.
        waits = number > 1 and shape in ("surface", "plane")
        steps.append(replace(code, after=(*code.after, StepId(StepKind.SHAPE))) if waits else code)
        steps.append(_pixels_step(projector, several=several))
        if number == 1 and len(rig.projectors) > 2 and shape != "unknown":
            steps.append(_first_shape_step(rig, prior, shape))
        steps.append(indirect_step(projector))
    steps.append(
        Step(
            StepId(StepKind.GEOMETRY),
            lambda context: _reconstruct(rig, prior, shape, context),
            inputs={"prior": repr(prior), "shape": shape},
            after=of_projectors(names, StepKind.PIXELS),
            title="Reconstructing the object and the poses",
            weight=costs.geometry_s(costs.scale(projector.size_px for projector in rig.projectors)),
        )
    )
    return steps


def _first_shape_step(rig: Rig, prior: CameraPrior, shape: AskedShape) -> Step:
    """Which shape two projectors see, beside the photographs of the others."""
    two = rig.projectors[:2]
    return Step(
        StepId(StepKind.SHAPE),
        lambda context: _first_shape(two, prior, shape, context),
        inputs={"prior": repr(prior), "shape": shape},
        after=of_projectors([projector.name for projector in two], StepKind.PIXELS),
        title="Finding which shape the object has",
        weight=costs.geometry_s(costs.scale(projector.size_px for projector in two)),
        calculates=True,
    )


TOO_LITTLE: Final = frozenset({"projector-dark", "projector-reaches-nothing", "projector-size-wrong"})
"""What a view finds that sees nothing, or next to nothing, of a projector: it stands behind the object."""


def _unless_unseen(
    found: Callable[[], Sequence[Path]], unseen: Callable[[], Sequence[Path]], *, several: bool, context: Context
) -> Sequence[Path]:
    """What a step leaves; where ``several`` views share the projectors, one may see too little of one of them."""
    try:
        return found()
    except CalibrationError as error:
        if not several or error.code not in TOO_LITTLE:
            raise
        context.reporter.say(f"Too little of this projector is seen from here: {error.what} Other cameras may see it.")
        return unseen()


def _radiometry_step(projector: RigProjector, *, several: bool) -> Step:
    return Step(
        StepId(StepKind.RADIOMETRY, projector.name),
        lambda context: _unless_unseen(
            lambda: _radiometry(projector, context),
            lambda: _no_light(projector, context),
            several=several,
            context=context,
        ),
        after=(StepId(StepKind.BLACK), StepId(StepKind.LIGHT, projector.name), StepId(StepKind.CAMERA)),
        title=f"Measuring the response of {projector.name}",
        weight=costs.RADIOMETRY_S * costs.scale([projector.size_px]),
        calculates=True,
    )


def _pixels_step(projector: RigProjector, *, several: bool) -> Step:
    return Step(
        StepId(StepKind.PIXELS, projector.name),
        lambda context: _unless_unseen(
            lambda: _pixels(projector, context),
            lambda: _no_pixels(projector, context),
            several=several,
            context=context,
        ),
        after=(StepId(StepKind.BLACK), *of_projectors([projector.name], StepKind.RADIOMETRY, StepKind.CODES)),
        title=f"Decoding {projector.name} and fitting its metapixels",
        weight=costs.PIXELS_S * costs.scale([projector.size_px]),
        calculates=True,
    )


def _radiometry(projector: RigProjector, context: Context) -> Sequence[Path]:
    used = PlanUsed.read(context.folder, projector.name)
    black = read_black(context.folder)
    taken = light_of(projector.name).by_name(context.folder)
    bracket = white_bracket(list(taken.values()))
    white = merge_photographs(bracket)
    context.advance(0.5)
    captures = Developed(taken, {"black": black, "white": white})
    radiometry, report = measure_radiometry(
        captures,
        used.plan(projector.size_px),
        known_px=used.known_px(context.folder, projector.name),
        noise=noise_of(bracket[0]),
    )
    said = {TroubleCode.WHITE_SEGMENT: white_segment(projector.name, radiometry.segment)}
    light = Light(
        response=radiometry.response,
        mixing=radiometry.mixing,
        white=np.maximum(white - black, 0).astype(np.float32),
        black=black,
        camera_to_xyz=_to_xyz(taken),
        segment=np.array([radiometry.segment]) if radiometry.segment else None,
        paint=radiometry.paint,
    )
    figures = write_radiometry_figures(context.folder, projector.name, asdict(report))
    told = tell(context, StepId(StepKind.RADIOMETRY, projector.name), said)
    return [light.write(context.folder, projector.name), figures, told]


def _to_xyz(taken: Mapping[str, TakenPhotograph]) -> Float64:
    matrix = next(iter(taken.values())).read().camera_to_xyz
    return SRGB_TO_XYZ if matrix is None else matrix


def _no_light(projector: RigProjector, context: Context) -> Sequence[Path]:
    """Of a projector that this view does not see, with a usual response, by which its patterns can be drawn."""
    black, usual = read_black(context.folder), np.tile(np.linspace(0, 1, 256) ** 2.2, (3, 1))
    taken = light_of(projector.name).by_name(context.folder)
    light = Light(usual, np.eye(3), np.zeros_like(black), black, _to_xyz(taken))
    return [light.write(context.folder, projector.name)]


def _no_pixels(projector: RigProjector, context: Context) -> Sequence[Path]:
    camera, size_px = Light.read(context.folder, projector.name).white.shape[:2], projector.size_px[::-1]
    nowhere, dark = np.full((*camera, 2), np.nan, np.float32), np.zeros(camera, np.float32)
    centre_px, round_px = np.zeros((*size_px, 2), np.float32), np.tile(np.array([1, 0, 1], np.float32), (*size_px, 1))
    pixels = Pixels(nowhere, dark, dark > 0, centre_px, round_px, centre_px[..., 0] > 0, nowhere, round_px, None)
    return [pixels.write(context.folder, projector.name)]


def _pixels(projector: RigProjector, context: Context) -> Sequence[Path]:
    light = Light.read(context.folder, projector.name)
    if not light.white.any():
        return _no_pixels(projector, context)
    used = PlanUsed.read(context.folder, projector.name)
    plan = used.plan(projector.size_px)
    taken = read_captures(context.folder, projector.name)
    ready = {"black": light.black, "white": light.white + light.black}
    captures = completed(Developed(taken, ready), plan)
    apart = colours_apart(captures, plan, light.white, light.mixing)
    shifts = colour_shifts(apart)
    apart_px = shifts.sure_px
    colours = None if apart_px is None else ColourPlaces.of(apart_px, light.white, light.mixing)
    blur_px = float(np.mean(np.square(CAMERA_BLUR_PX)) ** 0.5)
    correspondence = decode(
        captures,
        plan,
        camera_blur_px=blur_px,
        scratch=context.folder,
        known_px=used.known_px(context.folder, projector.name),
        noise=noise_of(taken[plan.sinusoids("phase-x")[0].name]),
        colours=colours,
    )
    if not correspondence.valid.any():
        raise CalibrationError(
            "projector-reaches-nothing",
            what=f"No pixel of projector {projector.name} was found on the object.",
            remedy="Check that it points at the object, is in focus and not blocked, and that the room is dark.",
        )
    context.advance(0.4, "correspondences")
    sizes = colour_sizes(apart, correspondence.projector_px)
    apart_said = {
        TroubleCode.PANEL_ALIGNMENT: misaligned(projector.name, shifts),
        TroubleCode.COLOUR_FRINGES: fringed(projector.name, sizes, projector.size_px),
    }
    fitted = fit_pixels(captures, plan, correspondence, colours, light.white)
    metapixels = fitted.metapixels
    pixels = Pixels(
        projector_px=correspondence.projector_px,
        modulation=correspondence.modulation,
        seen=correspondence.valid,
        centre_px=metapixels.centre_px,
        covariance_px2=metapixels.covariance_px2,
        valid=metapixels.valid,
        shown_px=fitted.phase_map.projector_px,
        spread_px2=fitted.phase_map.spread_px2,
        mosaic=fitted.mosaic,
        colours_px=apart_px,
        spread=None if fitted.spread is None else np.array(astuple(fitted.spread)),
    )
    valid, seen = np.count_nonzero(metapixels.valid), np.count_nonzero(correspondence.valid)
    noted = None if apart_px is None else tuple((float(x), float(y)) for x, y in apart_px)
    figures = PixelFigures(int(valid), int(metapixels.valid.size), int(seen), noted)
    said = tell(context, StepId(StepKind.PIXELS, projector.name), apart_said)
    return [pixels.write(context.folder, projector.name), figures.write(context.folder, projector.name), said]


def _first_shape(
    two: Sequence[RigProjector], prior: CameraPrior, shape: AskedShape, context: Context
) -> Sequence[Path]:
    """Raises CalibrationError as ``find_shape`` for what other projectors would see as well."""
    try:
        found, correspondences = _shape(two, prior, shape, context)
    except CalibrationError as error:
        if error.code in SEEN_BY_ALL:
            raise
        context.reporter.say(f"{error.what} The other projectors may show the shape.", Level.WARNING)
        return ()
    if _sees_all(correspondences):
        context.reporter.say(" and ".join(projector.name for projector in two) + f": {shape_sentence(found)}")
    return ()


SEEN_BY_ALL: Final = frozenset({"scene-flat", "not-flat", "camera-prior-contradicted", "surface-broken-up"})
"""Why a shape that is asked for is missing, where another projector does not help."""


def _sees_all(correspondences: Sequence[Correspondence]) -> bool:
    """Whether this view sees each of the projectors: one of several may not."""
    return all(own.valid.any() for own in correspondences)


def _shape(
    projectors: Sequence[RigProjector], prior: CameraPrior, shape: AskedShape, context: Context
) -> tuple[FoundShape, Sequence[Correspondence]]:
    correspondences = [read_correspondence(context.folder, projector.name) for projector in projectors]
    rows, columns = correspondences[0].valid.shape
    if not _sees_all(correspondences):  # the views that see it know where it stands
        return FoundShape("unknown", (columns, rows)), correspondences
    sizes = [projector.size_px for projector in projectors]
    tell = partial(context.advance, note="geometry")
    return find_shape(shape, correspondences, (columns, rows), sizes, prior, progress=tell), correspondences


def _reconstruct(rig: Rig, prior: CameraPrior, shape: AskedShape, context: Context) -> Sequence[Path]:
    found, correspondences = _shape(rig.projectors, prior, shape, context)
    if _sees_all(correspondences):
        context.reporter.say(shape_sentence(found))
    names = [projector.name for projector in rig.projectors]
    depth_m = _depth_m(found, correspondences)
    stride = stride_of(depth_m.shape)
    troubles = lens_troubles(context, rig.projectors, depth_m[::stride, ::stride])
    if found.shape == "surface" and found.reconstruction is not None:
        for name, lens in zip(names, found.reconstruction.geometry.projectors, strict=True):
            if (text := bent(name, lens)) is not None:
                troubles.append(Notice.warning(TroubleCode.LENS_DISTORTION, text, about=name))
    if found.shape == "unknown" and found.why is not None and len(names) > 1:
        text = f"{found.why.what} Wrapping, patterns, gloss, Blender and exports of the surface need a shape."
        troubles.append(Notice.warning(TroubleCode.SHAPE_UNKNOWN, text))
    said = tell_all(context, StepId(StepKind.GEOMETRY), troubles)
    return [*write_geometry(context.folder, names, found), said]


def _depth_m(found: FoundShape, correspondences: Sequence[Correspondence]) -> FloatImage:
    """(camera rows, columns), NaN where not known; without a shape 1 and 2 at both sides of a depth edge."""
    if found.reconstruction is not None:
        return found.reconstruction.geometry.points_m[..., 2]
    seen = np.logical_or.reduce([own.valid for own in correspondences])
    edge = np.logical_or.reduce([jumps(own) for own in correspondences])
    return np.where(seen, np.where(edge, np.float32(2), np.float32(1)), np.float32(np.nan))


COARSE_BITS: Final = 4
"""Of each axis of the code; finer stripes leave few places dark."""


def lens_troubles(context: Context, projectors: Sequence[RigProjector], depth_m: FloatImage) -> list[Notice]:
    """A trouble for each projector that has a veil; none where the code was shown in colours, or not at all.

    ``depth_m`` (rows, columns) float32: every so many camera pixels as ``stride_of`` says
    """
    lights = [Light.read(context.folder, projector.name) for projector in projectors]
    stride = stride_of(lights[0].white.shape)
    whites = [thinned(light.white, stride) for light in lights]
    found = []
    for n, projector in enumerate(projectors):
        parts = list(_dark_parts(context, projector, thinned(lights[n].black, stride), stride))
        glare = projector_glare(whites, n, parts, np.ascontiguousarray(depth_m))
        if (said := lens_veils(projector.name, glare.sure)) is not None:
            found.append(Notice.warning(TroubleCode.PROJECTOR_GLARE, said, about=projector.name))
    return found


def _dark_parts(context: Context, projector: RigProjector, black: FloatImage, stride: int) -> Iterator[DarkPart]:
    known = Pixels.read(context.folder, projector.name).phase_map
    plan = PlanUsed.read(context.folder, projector.name).plan(projector.size_px)
    stripes = [pattern for axis in (0, 1) for pattern in plan.gray(axis)[:COARSE_BITS]]
    if known is None or not stripes:
        return
    captures = Developed(read_captures(context.folder, projector.name), {})
    position_px = thinned(known.projector_px, stride)
    at = np.nan_to_num(position_px, nan=-1e4)
    for pattern in stripes:
        dark = stripe_parts(pattern, plan.size_px, position_px)[1]
        spread = spread_by_lens(np.asarray(frame(pattern, plan.size_px), np.float32))
        veil = cv2.remap(spread, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        light = thinned(captures[pattern.name], stride) - black
        yield DarkPart(light, dark, np.asarray(veil, np.float32))


__all__ = ["lens_troubles"]


def join_geometry(
    run: Path,
    projectors: Mapping[str, PoseTable | None],
    prior_of: Callable[[str], CameraPrior],
    asked: AskedShape,
    reporter: Reporter,
) -> bool:
    """Adjust all whole views of a run together, and write each one's geometry and place; whether that was done.

    One view alone is adjusted where poses were measured. ``projectors``: by name, what was measured of where they
    stand; ``prior_of``: of the camera of a view. Raises CalibrationError as ``join_views`` where a surface is ``asked``
    for; else views that can't be joined stay as they are, and a warning says why.
    """
    folders = view_folders(run)
    alone = len(folders) < 2 and not (any(projectors.values()) and read_shape(run).shape == "surface")
    if alone or asked in ("unknown", "plane"):
        return False
    masks = (read_metapixels(run, name).valid for name in projectors)
    sizes = [(valid.shape[1], valid.shape[0]) for valid in masks]
    try:
        views = [_seen(name, folder, list(projectors), sizes, prior_of(name)) for name, folder in folders.items()]
        joined = join_views(views, list(projectors), sizes, list(projectors.values()))
    except CalibrationError as error:
        if asked == "surface":
            raise
        if error.code == "pose-contradicted":
            reporter.say(f"{error.what} {error.remedy} No measured pose is used now.", Level.WARNING)
            without = dict.fromkeys(projectors)
            return join_geometry(run, without, lambda name: replace(prior_of(name), pose=None), asked, reporter)
        reporter.say(
            f"The views have no common shape: {error.what} {error.remedy} What needs no shape works in all of them.",
            Level.WARNING,
        )
        return False
    for folder, view, one in zip(folders.values(), views, joined, strict=True):
        write_geometry(folder, list(projectors), FoundShape("surface", view.camera_size, one.reconstruction))
        write_view_pose(folder, one.pose)
    if len(joined) > 1:
        reporter.say(f"{len(joined)} views are joined: their cameras and all projectors have one place each.")
    return True


def _seen(
    name: str, folder: Path, projectors: Sequence[str], sizes: Sequence[tuple[int, int]], prior: CameraPrior
) -> SeenStage:
    size = camera_px(folder)
    assert size is not None, "a whole view has a camera picture"
    seen = [read_correspondence(folder, one) for one in projectors]
    chosen = [n for n, own in enumerate(seen) if int(np.count_nonzero(own.valid)) >= FEWEST_POINTS]
    found: Sequence[Pinhole]
    if has_geometry(folder):
        found = [read_geometry(folder, projectors).projectors[n] for n in chosen]
    else:
        # a view may see too little of a projector for a geometry with all of them
        found = first_poses([seen[n] for n in chosen], size, [sizes[n] for n in chosen], prior)
    kept = [own if n in chosen else _nothing(own) for n, own in enumerate(seen)]
    return SeenStage(name, kept, size, prior, dict(zip(chosen, found, strict=True)))


def _nothing(own: Correspondence) -> Correspondence:
    return Correspondence(np.full_like(own.projector_px, np.nan), own.modulation, np.zeros_like(own.valid))
