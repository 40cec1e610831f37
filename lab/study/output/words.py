"""Texts of the pages: what an experiment shows and what it does not, and why it misses a criterion.

No text holds a measured number: it would be of another run than the page. An experiment tells those itself.

Apart from the experiments, so that a better sentence does not make an experiment be done again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

DESCRIPTIONS: Final[Mapping[str, str]] = {
    "ablation": """\
The same target, solved with more and more parts of the method, and photographed. *Naive inverse*: the light of
photographed dots, inverted without bounds (LSMR) and clipped afterwards. *Gaussian metapixels*: fitted
to the same dots, without any correction of their centres. *Regularisation*: centres moved in order of priority,
gaps filled. *Smoothness*: eq. 3 at its default strength. *Quadrilaterals* replace the Gaussians; everything else is
as in the step before. Rows of each light transport are scaled so that all pixels at white give the white image
(decision 5). The paper does not scale them, so the early steps are better here than in the paper.""",
    "ablation-plain": """\
The ablation's target and steps, from dots as the paper's camera saw them: each pattern photographed once, no longer
than white, where a dot is much fainter than white. No row of a light transport is scaled: each projector pixel lights
what its dot showed, or its Gaussian, as bright as it was fitted to the dot (eq. 8), and neighbours' light adds up to
more or less than the white image. The page [What each part is worth](ablation.md) has the same steps from dots
photographed longer, with scaled rows; its stages may stand in another room. White, black and the pictures that are
judged are HDR in both. The regularised centres keep their fitted brightness; gaps get the median one.""",
    "regions": """\
A piece of the camera's picture of one target, solved in four phases of regions (paper 3.2; they overlap by 25
%), and globally. Differences are over the piece without a border of half of the largest region. Times are wall
times of this piece on a busy machine. They show which variant is slower, not how long the paper's would take here;
`lab/timings/README.md` has times of the whole picture.""",
    "residual": """\
A checkerboard on a pale curved shell, as the paper describes it: the first two projectors stand to the left, and light
the right half at grazing angles or not at all; the third stands to the right. Everything is compared over the whole
object that any of the three lights, at two exposures: as bright as all three can make 95 % of it, and as bright as
the first can make 95 % of what it lights. *Normalised residual*: rms difference of photograph and target in a region
of 16x16 camera pixels, over the target's white; the mean is over regions. The paper says neither what it normalises
by nor whether its figures are from the solve or from photographs; both are given here. Its shape and angles are not
known to the degree either: places and squares were chosen before anything was measured, and not changed after. With
smaller squares, more regions contain an edge, and every figure is larger.""",
    "residual-sweep": """\
The checkerboard of the page [Residual with one, two and three projectors](residual.md), with squares of three sizes, at
four exposures, its residual normalised in five ways. The paper tells none of the three, and none is chosen here: the
table shows which of them bring which of its figures. *Fall* is the residual with one projector over that with three; a
square of a residual falls as the square of it, so the paper's fall of about seven times is not the same statement for
both. All figures are means over regions of 16x16 camera pixels, over all that any of the three lights.""",
    "sharpness": """\
lambda counts the edge pixels that photograph and target have in common over the larger number of edge pixels
(eq. 9), in the neighbourhood of each pixel; edges are Canny's, at the target's own threshold. Two targets: a
checkerboard, as in the paper, and a photograph, whose edges have all directions and strengths. *Naive* is the light of
photographed dots, inverted without bounds and clipped afterwards; *full* is the bounded, smooth solve on the calibrated
shares. All four make the same target at an exposure that one projector can reach. The paper does not say how
large its neighbourhoods are: ours were chosen before anything was measured.""",
    "frequency": """\
Bands of upright waves around a grey, faint and bold, their frequency rising downwards, over the middle of a
pale shell, at an exposure that one projector can reach. *Contrast kept* is the amplitude in phase with the
target's wave, in the photograph's green channel, over the target's own as the camera sees it; light at
another phase or frequency counts as lost. F is the frequency where it first falls below a half. The paper says
neither which contrast nor which criterion it used. The bases, for the faint waves, contain the target's detail above
a frequency, or only the detail below it, and are multiplied by the remaining scale (eqs 4-6). *As the plan calculates
it*: as `velatura plan` does, from the measured blur, pitch and light. *By stripes*, as in the paper's figure, target
and photograph are white where they are above their mean along the row, else black. Stripes are right while 80 % of the
pixels agree with the target's, and the number of stripes does within a tenth. Superposition adds positions of light,
not contrast, so the blur of the optics limits how much finer three are than one; [another page](frequency-sharp.md)
has sharper ones.""",
    "earlier": """\
The same target at an exposure that the best projector can reach alone, so that brightness makes no difference.
*One projector* divides at each pixel (Nayar 2003, Grossberg 2004). *Feathered* lights each point with its brightest
projector and blends the seams, in the spirit of Raskar 2001. *Unconstrained inverse* inverts the light of
photographed dots and clips afterwards, in the spirit of Wetzstein and Bimber 2007. *Bounded, no pixel model*
keeps the bounds inside the solve on the same dots. All of them get our correction for light that comes back from the
room, which none of them had. These are our own implementations on our calibration, which is better than theirs was;
none of their code was run.""",
    "live": """\
One target by base times scale: base and scale are multiplied projector pixel by projector pixel, which takes
milliseconds where a solve takes seconds. By *eq. 6* a pixel's scale is the mean over its light; shown, the pixel
blurs it a second time. *Narrower means* are used by `velatura live`: means over a Gaussian 0.4 times as wide
(decision 10), in 8-bit frames; those of eq. 6 are dithered from floating point. The base *white* cancels
the object's own pattern at full resolution; *minimum* leaves that to the scale. With either mean it shows
speckles where it has almost no light itself, mostly at depth edges. The seconds include work that is done once: maps
and compiled code.""",
}
SHARP_DESCRIPTION: Final = """\
The same waves as on the page [The finest sinusoid](frequency.md), on a stage with sharper optics: the shell with three
projectors at planned places, their lenses better than the usual ones of the bench (0.2 pixels in focus) and stopped
down until no depth of the object is out of focus. Everything else is as there."""
SIX_PROJECTORS_DESCRIPTION: Final = """\
As the page of three projectors, on the same shell with six round it: left, right, above, far left, far right, high.
Three of them light all of it about evenly, so the first three are not those of the other page. Everything is compared
over the whole object that any of the six lights, at two exposures: as bright as all six can make 95 % of it, and as
bright as the first can make 95 % of what it lights. The paper's figures are of an exposure that three can make, and are
asked on that page alone: at one that only six can make, the first three lack light."""

TOO_FINE: Final = """\
What is left lies at edges, of the target or of the object's own paint, which are finer than the projectors' pixels. For
the recoloured object this was tested by the model: without smoothness, without weights and with a ten times stricter
solve it stays; with a fifth of the light it falls by less than a third, which is not enough."""

MISS_REASONS: Final[Mapping[tuple[str, str], str]] = {
    ("ablation", "+ Gaussian metapixels"): """\
The raw light beats the Gaussians here. Its dots are photographed up to 16 times longer than white and its rows
are scaled, so it contains the pixels' true shape with little noise. A Gaussian has neither their nearly square
shape nor the paint's edges inside a pixel. Our shares reach about the same error without any photograph of dots.
Fainter dots were not tried.""",
    ("ablation", "+ regularisation"): """\
It moves the few centres that dots located badly, so the large errors become smaller (RMSE) and the median hardly
changes.""",
    ("ablation", "+ smoothness"): """\
Smoothness removes noise from the frames, so that CIEDE2000 and RMSE fall, and a little detail, too: SSIM falls, and so
does lambda.""",
    ("ablation-plain", "+ Gaussian metapixels"): """\
A Gaussian has less of a faint dot's noise, so colours come nearer; the dot itself has the sharper pixel, so that lambda
and SSIM are higher without it.""",
    ("ablation-plain", "+ regularisation"): """\
It changes little here: the table has about the same errors before and after. Its moved centres keep the brightness that
was fitted where they were.""",
    ("earlier", "ours is better than: bounded, no pixel model"): """\
Dots photographed as well as here are as good a light transport as our shares, at the price of 49 and more
photographs a projector (see the ablation). Ours is smoothed. In the ablation, smoothness costs SSIM, too, but less
than is missing here; why the rest is missing was not found.""",
    ("residual", "mean, median region"): """\
Each projector adds the errors of its own calibration and its own noise; where one already reaches a region well, the
next cannot make it better. That is what the median region shows, and the mean hides.""",
    ("residual-sweep", "somewhere in the sweep"): """\
Where squares are normalised, at exposures that one or two can make, one and two projectors come to the paper's figures,
and three far below them, which counts as off, too. Without squares, the paper's fall is met where the target is
brightest, at several times its figures: there light is lacking, as the page of three projectors says.""",
    ("residual-six", "mean, median region"): """\
Where two projectors light a region well, further ones can hardly make it better: by the model they reduce the residual
a little more, but the errors of their own calibration add as much. What is left of the mean and of the 95 % lies at
the object's rim, as the maps show.""",
    ("appearances", "every appearance: CIEDE2000 at most"): TOO_FINE,
    ("appearances", "every appearance: at least"): """\
Where a target is so dim and smooth that one projector comes near it, too, three times nearer lies below what the
calibration and its noise allow.""",
    ("robustness", "indirect light"): """\
Light that comes back from the room also falls where the target is dark, and no frame can take it away: many more pixels
are out of reach, as the table says, and too bright. A target with less contrast was not tried.""",
    ("robustness", "a visitor's shadow"): """\
The covered pixels lack one projector's light, and nothing measures that while a picture is shown. The median hardly
changes, because most pixels are not covered.""",
    ("frequency", "F_3 / F_1 at least 1.4, at 50% contrast"): """\
To make a wave finer than one projector's pixels, three have to sharpen it against their blur, up to full light and
down to none, and a bold wave leaves less room for that than a faint one.""",
    ("frequency", "F_3 / F_1 at least 1.4, by stripes"): """\
A bold wave leaves three projectors less room than a faint one to sharpen it against their blur, up to full light and
down to none. The stripes of the faint wave are that much finer on all three stages.""",
    ("frequency", "F_3 / F_1 at least 1.4, by contrast"): """\
Half of the contrast is kept only where three projectors sharpen the wave against the blur of their optics, and a bold
wave leaves little room for that. Stripes need no contrast, and sharper optics keep more of it.""",
    ("frequency", "a base low-passed at F_1 falls"): """\
The filter halves what lies at F_1, and lets some finer detail into the base; a threshold shows stripes however faint
they are. By contrast it falls to F_1, within 7 %.""",
    ("frequency", "F_3 as the plan"): """\
The plan draws at random how the pixels of three projectors lie beside each other, and a stage has one of these places:
two stages are 5 and 7 % finer than calculated, the third 11 %. How much of that is due to the places was not
measured.""",
    ("frequency", "a base high-passed at F_1 keeps"): """\
The scale is a mean over each metapixel (eq. 6), and the projector's pixel blurs it once more: it loses contrast
well below F_1, so the detail that the base leaves to it there is partly lost. Narrower means (decision 10) lose less;
with the base's limit at a quarter of F_1 nothing is lost.""",
}
"""Why a criterion of an experiment is missed, by the experiment's name and the beginning of what is asked."""


def description(name: str) -> str:
    """The paragraph of an experiment, or nothing."""
    beside = {"residual-six": SIX_PROJECTORS_DESCRIPTION, "frequency-sharp": SHARP_DESCRIPTION}
    return beside.get(name) or DESCRIPTIONS.get(name, "")


def miss_reason(name: str, asked: str) -> str:
    """Why the criterion is missed, as far as it was found; nothing where nothing was written down."""
    own = name.removesuffix("-sharp")
    return " ".join(text for (one, begins), text in MISS_REASONS.items() if one == own and asked.startswith(begins))
