"""Completion of what no frame showed well, from what frames did, within its own segment of the body.

For each vertex a *guess* is made of what is known elsewhere (``guess``): its mirror image where the other
side was seen, else what was seen nearest on the same ring of the same limb, else of its segment. So garments
end where they end in front, and what only the chest shows, a print or a shirt, is not carried to the back.
What is known beside it then bends the guess, over a few centimetres (``screened_membrane`` of the
difference: Perez et al., Poisson image editing, 2003): each vertex by how much is known of it, the finest
grain left out, and what stands out from the others around it hardly at all (``bent``). So neither the wall
beside a silhouette nor an ear on the cheek is carried on.

On a head hair and skin do not end where segments do. There two such fields are made, one of what is coloured
as hair and one of what is coloured as skin, and mixed by which of the two is likelier at each place
(``head_field``, ``hair_share``).

The unseen side is not lit as the seen one: the lamp of a frontal clip stands in front. So log brightness is
fitted as ``c_part + b . n`` over the known vertices, n being the normal in the world, robustly, since
materials differ within a part too; ``b . n`` is then known for every vertex, and is held to the range that
was seen, for nothing says how dark it gets beyond (``shading``).

Everything blends continuously by trust: 1 keeps a vertex as it is, 0 takes the completion.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse

from pipeline.texture.membrane import neighbours, screened_membrane
from pipeline.texture.segments import (
    BODY,
    FACE,
    HEAD,
    LEFT_HAND,
    NECK,
    OTHER_SIDE,
    RIGHT_HAND,
    SCALP,
    SKIN,
    Segments,
)

REACH = {FACE: 0.06, SCALP: 0.02, NECK: 0.03, BODY: 0.03}
"""Metres over which what is known beside a guess bends it; hands as the rest."""

RINGS = ((0.012, 1.0), (0.05, 1e-3), (10.0, 1e-6))  # widths along a limb, metres, and what each counts
TURNS = ((0.6, 1.0), (10.0, 1e-6))  # widths around it, radians: a jacket's back is like its sides
BIN, TURN_BINS = 0.004, 24  # metres along a limb; parts of a turn around it
GRAIN = 0.012  # metres: what varies within less is left out of what bends a guess
STANDS_OUT = 0.1  # distance from what lies around, in [0, 1], at which a colour tells little
REWEIGHTED = 2  # rounds of that
HEAD_REACH = 0.06  # metres, of hair and of skin on a head
HAIRLINE = 0.012  # metres over which hair passes into skin where nothing is known
MIXED = 0.25, 0.75  # shares of hair, between which both are mixed
CLEAR = 0.5  # of the distance between hair and skin: what is farther from both is neither
FIRM = 50.0  # how firmly a wholly trusted vertex is held, against an edge's 1
SKIN_LIKE = 0.13  # distance of two colours, in [0, 1], at which they are hardly of one kind
LEAST_SOURCE = 0.02  # what the skin's own colour still counts as a source of hair or cloth
DARK = 4.0 / 255  # mean colour: logarithms below say nothing
ROUNDS = 10  # of reweighting
SOFT = 0.15  # of log brightness, where an error begins to count linearly
RANGE = (2.0, 98.0)  # percentiles of what was seen, to which shading is held
LEAST = 200  # known vertices, under which there is nothing to fit
RIDGE = 1e-3  # of the summed weight, on the slope


def complete_colors(
    segments: Segments,
    color: np.ndarray,  # [N, 3]
    trust: np.ndarray,  # [N]
    normals: np.ndarray | None = None,  # [N, 3]
    telling: np.ndarray | None = None,  # [N]
) -> np.ndarray:
    """A colour for every vertex: [N, 3] float64 in [0, 1].

    Args:
        segments: of the surface, N vertices.
        color: RGB in [0, 1]; of no consequence where trust is 0.
        trust: in [0, 1].
        normals: mean normals in the world over the frames, short where the body turned; light is left out
            of account if None.
        telling: in [0, 1], how far others may be told by each colour; as far as it is trusted if None.
    """
    telling = trust if telling is None or not (telling > 0).any() else telling
    if not (telling > 0).any():
        return np.full((len(segments), 3), 0.5)
    share = np.clip(trust, 0, 1)[:, None].astype(np.float64)
    if (share == 1).all():
        return np.asarray(color, np.float64).copy()
    field, _ = color_field(segments, color, telling, normals)
    return np.where(share == 1, color, share * np.where(share > 0, color, 0) + (1 - share) * field)


def color_field(
    segments: Segments,
    color: np.ndarray,  # [N, 3]
    telling: np.ndarray,  # [N]
    normals: np.ndarray | None = None,  # [N, 3]
) -> tuple[np.ndarray, np.ndarray]:
    """The colour that each vertex has by what others of its kind show, calm and without grain: [N, 3].

    The arguments are those of ``complete_colors``; some vertex tells something. The second value is how
    likely each is hair, [N] in [0, 1].
    """
    shade = np.ones((len(segments), 1))
    source = spreading(segments, color, telling)
    if normals is not None:
        shade = np.exp(shading(color, source, normals, segments.part))[:, None]
    flat = color / shade
    head = head_field(segments, flat, telling)
    field, hair = np.empty_like(flat), segments.is_in(SCALP).astype(np.float64)
    if head is not None:
        field[segments.is_in(*HEAD)], hair[segments.is_in(*HEAD)] = head
    rows = np.flatnonzero(np.ones(len(segments)) if head is None else ~segments.is_in(*HEAD))
    reach = np.array([REACH.get(label, REACH[BODY]) for label in range(segments.label.max() + 1)])
    guessed = guess(segments, flat, source)[rows]
    links = neighbours(_among(segments.edges, rows, len(segments)), len(rows))
    field[rows] = bent(
        links, guessed, flat[rows], source[rows], segments.spacing[rows], reach[segments.label[rows]]
    )
    return np.clip(field * shade, 0, 1), hair


def bent(
    links: sparse.csr_matrix,  # [M, M]
    guessed: np.ndarray,  # [M, 3]
    color: np.ndarray,  # [M, 3]
    source: np.ndarray,  # [M]
    spacing: np.ndarray,  # [M]
    reach: np.ndarray,  # [M]
) -> np.ndarray:
    """Guesses bent by the colours beside them; those that stand out are outvoted: [M, 3].

    Args:
        links: the graph of the vertices.
        guessed: of every vertex.
        color: what is known; of no consequence where source is 0.
        source: in [0, 1], how much each tells.
        spacing: metres between neighbours.
        reach: metres over which a guess is bent.
    """
    difference = np.where(source[:, None] > 0, color - guessed, 0)
    sink, hold = np.maximum((spacing / reach) ** 2, 1e-6), (spacing / GRAIN) ** 2 * source
    moved, fits = np.zeros_like(difference), np.ones(len(source))
    for _ in range(REWEIGHTED):
        moved = screened_membrane(links, difference, hold * fits, sink)
        fits = (1 + (distance(difference, moved) / STANDS_OUT) ** 2) ** -2
    return guessed + moved


def head_field(
    segments: Segments, flat: np.ndarray, telling: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The colours of face, scalp and neck, mixed of hair and skin, [M, 3], and the share of hair, [M].

    None where the head shows but one of the two.

    Args:
        segments: of the surface.
        flat: [N, 3], colours without shading.
        telling: [N] in [0, 1].
    """
    tones = head_tones(segments, flat, telling)
    if tones is None:
        return None
    rows = np.flatnonzero(segments.is_in(*HEAD))
    links = neighbours(
        _among(np.concatenate([segments.edges, segments.seams]), rows, len(segments)), len(rows)
    )
    away = np.stack([distance(flat, tone) for tone in tones]) / distance(tones[:1], tones[1])
    clear = 1 / (1 + (away.min(0) / CLEAR) ** 4)
    hair_like = 1 / (1 + np.exp(np.clip(8 * (away[1] - away[0]), -50, 50)))
    share = hair_share(segments, links, rows, hair_like, telling * clear)
    reach, fields = np.full(len(rows), HEAD_REACH), []
    for tone, like in zip(tones, (1 - hair_like, hair_like), strict=True):
        source, guessed = (telling * clear * like)[rows], np.tile(tone, (len(rows), 1))
        fields.append(bent(links, guessed, flat[rows], source, segments.spacing[rows], reach))
    field = fields[0] + share[:, None] * (fields[1] - fields[0])
    mirrored = segments.mirrored[rows]
    better = (telling[mirrored] * segments.is_in(*HEAD)[mirrored] * (1 - telling[rows]))[:, None]
    return field + better * (flat[mirrored] - field), share


def head_tones(segments: Segments, flat: np.ndarray, telling: np.ndarray) -> np.ndarray | None:
    """The colours of a head's skin and hair, [2, 3]; None where either is unknown or they are alike."""
    face, scalp = segments.is_in(FACE), segments.is_in(SCALP)
    if not (telling[face] > 0).any():
        return None
    skin = weighted_median(flat[face], telling[face] ** 2)
    weight = telling[scalp] ** 2 * np.clip(distance(flat[scalp], skin) / SKIN_LIKE - 0.5, 0, 1)
    if not (weight > 0).any():
        return None
    tones = np.stack([skin, weighted_median(flat[scalp], weight)])
    return tones if distance(tones[:1], tones[1])[0] > SKIN_LIKE else None


def hair_share(
    segments: Segments,
    links: sparse.csr_matrix,  # [M, M]
    rows: np.ndarray,  # [M]
    hair_like: np.ndarray,  # [N]
    telling: np.ndarray,  # [N]
) -> np.ndarray:
    """How likely each vertex of a head is hair, [M], by its colour or its mirror image's, or its segment."""
    scalp, mirrored = segments.is_in(SCALP)[rows].astype(np.float64), segments.mirrored
    better = segments.is_in(*HEAD)[mirrored] & (telling[mirrored] > telling)
    telling, hair_like = (np.where(better, one[mirrored], one) for one in (telling, hair_like))
    hold = (segments.spacing[rows] / HAIRLINE) ** 2
    known = FIRM * telling[rows] ** 2
    values = (hold * scalp + known * hair_like[rows]) / (hold + known)
    share = screened_membrane(links, values[:, None], hold + known, np.zeros(len(rows)))[:, 0]
    return np.clip((share - MIXED[0]) / (MIXED[1] - MIXED[0]), 0, 1)


def _among(edges: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """The edges between some of ``count`` vertices, numbered by their places in ``rows``."""
    place = np.full(count, -1)
    place[rows] = np.arange(len(rows))
    return place[edges[(place[edges] >= 0).all(1)]]


def complete_log_scales(
    segments: Segments,
    log_scale: np.ndarray,  # [N, C]
    trust: np.ndarray,  # [N]
    covers: float | Sequence[float] = 0.0,
) -> np.ndarray:
    """A log scale for every vertex, [N, C] float64: ``covers``, one or C of them, where nothing is known."""
    guessed = np.broadcast_to(np.asarray(covers, log_scale.dtype), log_scale.shape)
    return completed(segments, log_scale, guessed, trust, trust)


def completed(
    segments: Segments,
    values: np.ndarray,  # [N, C]
    guessed: np.ndarray,  # [N, C]
    trust: np.ndarray,  # [N]
    source: np.ndarray,  # [N]
) -> np.ndarray:
    """Values where they are trusted, guesses bent to meet them where not: [N, C] float64.

    Args:
        segments: of the surface.
        values: what was learnt; of no consequence where trust is 0.
        guessed: of every vertex.
        trust: in [0, 1]; a vertex of trust 1 keeps its value exactly.
        source: [N] in [0, 1], how far each value may bend what lies beside it.
    """
    values = np.asarray(values, np.float64)
    share = np.clip(trust, 0, 1)[:, None].astype(np.float64)
    if (share == 1).all():
        return values.copy()
    hold = _hold(source)
    reach = np.array([REACH.get(label, REACH[BODY]) for label in range(segments.label.max() + 1)])
    sink = np.maximum((segments.spacing / reach[segments.label]) ** 2, 1e-6)
    difference = np.where(source[:, None] > 0, values - guessed, 0)
    bent = screened_membrane(neighbours(segments.edges, len(segments)), difference, hold, sink)
    mixed = share * np.where(share > 0, values, 0) + (1 - share) * (guessed + bent)
    return np.where(share == 1, values, mixed)


def _hold(trust: np.ndarray) -> np.ndarray:
    return FIRM * trust**2


def spreading(
    segments: Segments,
    color: np.ndarray,  # [N, 3]
    trust: np.ndarray,  # [N]
) -> np.ndarray:
    """How far each vertex may be a source of others: [N] float64 in [0, 1].

    It is trust, and less on scalp and body where the colour is that of the face's skin: a forehead under the
    hairline, the neck above a collar; on hands less where it is not: the shirt behind them. Where all of a
    segment is so all of it counts alike.
    """
    face = segments.is_in(FACE)
    source = np.clip(trust, 0, 1).astype(np.float64)
    if not (trust[face] > 0).any():
        return source
    skin = weighted_median(color[face], source[face])
    like = np.exp(-(distance(color, skin) ** 2) / (2 * (SKIN_LIKE / 2) ** 2))
    for label in (SCALP, BODY, LEFT_HAND, RIGHT_HAND):
        rows = segments.is_in(label)
        fits = 1 - like[rows] if label in (SCALP, BODY) else np.sqrt(like[rows])
        source[rows] *= np.maximum(fits, LEAST_SOURCE)
        largest = source[rows].max(initial=0.0)
        source[rows] /= max(largest, 1e-12) if 0 < largest < 0.5 else 1.0
    return source


def distance(color: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances of colours [N, 3] from another [3] in which brightness counts half as much as hue: [N]."""
    away = color - other
    grey = away.mean(1, keepdims=True)
    return np.sqrt(np.square(away - grey).sum(1) + 0.25 * 3 * np.square(grey[:, 0]))


def guess(
    segments: Segments,
    values: np.ndarray,  # [N, C]
    source: np.ndarray,  # [N]
) -> np.ndarray:
    """What each vertex is most likely to be, told by others: [N, C] float64.

    The mirror image as far as that is known, else the ring of the limb; scalp and face have no rings, there
    it is the median. A segment of skin without any source takes other skin's, any other the mean of all.
    """
    weight, values = source**2, np.asarray(values, np.float64)
    everywhere = np.average(values, axis=0, weights=weight + 1e-12)
    bare = segments.is_in(*SKIN) & (weight > 0)
    skin = weighted_median(values[bare], weight[bare]) if bare.any() else everywhere
    found = np.tile(everywhere, (len(segments), 1))
    for label in np.unique(segments.label):
        rows = segments.is_in(label)
        known = weight[rows].sum() > 0
        if not known:
            found[rows] = skin if label in SKIN else everywhere
        elif label in (FACE, SCALP):
            found[rows] = weighted_median(values[rows], weight[rows])
        else:
            _fill_rings(found, rows, segments, values, weight)
    mirrored = segments.mirrored
    same = segments.label[mirrored] == OTHER_SIDE[segments.label]
    share = (source[mirrored] * same)[:, None]
    return share * values[mirrored] + (1 - share) * found


def _fill_rings(
    found: np.ndarray, rows: np.ndarray, segments: Segments, values: np.ndarray, weight: np.ndarray
) -> None:
    """Writes means over rings of each limb into rows of ``found``."""
    whole = np.average(values[rows], axis=0, weights=weight[rows])
    for part in np.unique(segments.part[rows]):
        limb = np.flatnonzero(rows & (segments.part == part))
        found[limb] = whole
        if weight[limb].sum() > 0:
            found[limb] = _ring_means(segments.along[limb], segments.around[limb], values[limb], weight[limb])


def _ring_means(along: np.ndarray, around: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted means of what lies near along and around a limb, wider where nothing does: [K, C]."""
    place = ((along - along.min()) / BIN).astype(int)
    turn = ((around + np.pi) / (2 * np.pi) * TURN_BINS).astype(int) % TURN_BINS
    shape = (place.max() + 1, TURN_BINS)
    cell = place * TURN_BINS + turn
    columns = [weight, *(weight * column for column in values.T)]
    sums = np.stack([np.bincount(cell, one, shape[0] * shape[1]).reshape(shape) for one in columns])
    apart = np.abs(np.arange(shape[0])[:, None] - np.arange(shape[0]))
    turned = np.abs(np.arange(TURN_BINS)[:, None] - np.arange(TURN_BINS))
    turned = np.minimum(turned, TURN_BINS - turned)
    means = _kernel(BIN * apart, RINGS) @ sums @ _kernel(2 * np.pi / TURN_BINS * turned, TURNS)
    return (means[1:] / np.maximum(means[0], 1e-30))[:, place, turn].T


def _kernel(away: np.ndarray, widths: tuple[tuple[float, float], ...]) -> np.ndarray:
    """Gaussians of several widths, each with its share, summed."""
    return np.sum([share * np.exp(-0.5 * (away / width) ** 2) for width, share in widths], axis=0)


def weighted_median(
    values: np.ndarray,  # [N, C]
    weights: np.ndarray,  # [N]
) -> np.ndarray:
    """The value, of each column, at which half of the weight is reached: [C] float64."""
    order = np.argsort(values, axis=0, kind="stable")
    reached = np.cumsum(weights[order], axis=0)
    place = (reached >= 0.5 * reached[-1:]).argmax(0)
    return np.take_along_axis(values, np.take_along_axis(order, place[None], 0), 0)[0].astype(np.float64)


def shading(color: np.ndarray, weight: np.ndarray, normal: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The logarithm of each vertex's shading: [N] float64.

    Args:
        color: [N, 3], RGB in [0, 1].
        weight: [N], 0 where the colour is not known.
        normal: [N, 3], mean normals in the world; short where the body turned.
        part: [N] int, each with a brightness of its own.
    """
    known = np.flatnonzero((weight > 0) & (color.mean(1) > DARK))
    if len(known) < LEAST:
        return np.zeros(len(color))
    brightness = np.log(color[known].mean(1))
    share, groups = np.minimum(weight[known], np.median(weight[known])), part[known]
    slope, level = np.zeros(3), np.zeros(int(part.max()) + 1)
    robust = np.ones(len(known))
    for _ in range(ROUNDS):
        heft = share * robust
        total = np.maximum(_sums(groups, heft, len(level)), 1e-12)
        # Parts' levels are taken out first: what is left is a fit of three numbers.
        centred = (
            normal[known]
            - (_sums(groups, heft[:, None] * normal[known], len(level)) / total[:, None])[groups]
        )
        level_now = (_sums(groups, heft * brightness, len(level)) / total)[groups]
        square = (heft[:, None] * centred).T @ centred + RIDGE * heft.sum() * np.eye(3)
        slope = np.linalg.solve(square, (heft[:, None] * centred).T @ (brightness - level_now))
        error = np.abs(brightness - level_now - centred @ slope)
        robust = np.minimum(1, SOFT / np.maximum(error, 1e-9))
    shade = normal @ slope
    return np.clip(shade, *np.percentile(shade[known], RANGE))


def _sums(groups: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums of values [K] or [K, C] by group: [count] or [count, C]."""
    pick = sparse.coo_matrix((np.ones(len(groups)), (groups, np.arange(len(groups)))), (count, len(groups)))
    return np.asarray(pick @ values)
