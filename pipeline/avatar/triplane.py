"""The triplane field: learnable features on three planes, one set of planes a region.

The paper's Section 3.3: a canonical position is projected onto the planes XY, XZ and YZ, and
bilinear interpolation on each gives its feature ``f_i``. The head has planes of its own, fitted to
its box, because it holds most of the detail in a small part of the body's box.

Canonical positions do not move during training. So sampling is a constant linear map from texels to
features, and is applied as one sparse product (three times cheaper than ``grid_sample``, to which
it is equal: tests/unit/test_avatar_triplane.py).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.avatar.sparse import SparsePair

PLANES = ((0, 1), (0, 2), (1, 2))
MARGIN = 1.05  # keeps the outermost points off the outermost texels


def bounding_boxes(points: Tensor, regions: Tensor) -> Tensor:
    """The centre and half extent of each region's points, a margin included.

    Args:
        points: [N, 3] canonical positions, metres.
        regions: [N] int64, the region that each point belongs to, numbered 0, 1, ... without gaps.

    Returns:
        [R, 2, 3]: centre and half extent of every region, metres.
    """
    boxes = []
    for region in range(int(regions.max()) + 1):
        inside = points[regions == region]
        low, high = inside.amin(0), inside.amax(0)
        boxes.append(torch.stack([(low + high) / 2, ((high - low) / 2 * MARGIN).clamp_min(1e-6)]))
    return torch.stack(boxes)


def normalise(points: Tensor, regions: Tensor, boxes: Tensor) -> Tensor:
    """Canonical positions in their region's box: [N, 3] metres -> [N, 3] in [-1, 1]."""
    box = boxes[regions]
    return (points - box[:, 0]) / box[:, 1]


def sampling_matrix(coordinates: Tensor, regions: Tensor, region_count: int, resolution: int) -> SparsePair:
    """Bilinear sampling of all planes at fixed coordinates, as a sparse matrix.

    Equal to ``torch.nn.functional.grid_sample(..., align_corners=True, padding_mode="border")`` on
    each plane. The first coordinate of a plane runs along its last spatial axis.

    Args:
        coordinates: [N, 3] in [-1, 1].
        regions: [N] int64.
        region_count: R.
        resolution: texels along each side of a plane.

    Returns:
        Matrix of shape [3 N, R * 3 * resolution^2]: row ``3 i + k`` reads plane k for point i.
    """
    count = len(coordinates)
    texel = ((coordinates.double() + 1) / 2 * (resolution - 1)).clamp(0, resolution - 1)
    corner = texel.floor().long().clamp_max(resolution - 2)
    fraction = texel - corner
    rows, columns, values = [], [], []
    for plane, (across, down) in enumerate(PLANES):
        row = torch.arange(count) * 3 + plane
        first = ((regions * 3 + plane) * resolution + corner[:, down]) * resolution + corner[:, across]
        u, v = fraction[:, across], fraction[:, down]
        for step, weight in (
            (0, (1 - u) * (1 - v)),
            (1, u * (1 - v)),
            (resolution, (1 - u) * v),
            (resolution + 1, u * v),
        ):
            rows.append(row)
            columns.append(first + step)
            values.append(weight)
    shape = (3 * count, region_count * 3 * resolution**2)
    return SparsePair.build(torch.cat(rows), torch.cat(columns), torch.cat(values).float(), shape)


class Triplane(nn.Module):
    """Learnable planes, ``T`` in the paper, for every region.

    Attributes:
        planes: [R, 3, resolution, resolution, channels]; the channel runs fastest, so that a texel
            is one row of the sparse product.
    """

    def __init__(
        self,
        regions: int,
        resolution: int,
        channels: int,
        generator: torch.Generator,
        deviation: float = 0.01,
    ):
        """Draws small random features: zeros give every point the same gradient in the first step."""
        super().__init__()
        shape = (regions, 3, resolution, resolution, channels)
        self.planes = nn.Parameter(torch.randn(shape, generator=generator) * deviation)

    @property
    def features(self) -> int:
        """The length of ``f_i``."""
        return 3 * self.planes.shape[-1]

    def forward(self, samples: SparsePair) -> Tensor:
        """The features of the points that ``samples`` was built for, [N, 3 * channels]."""
        texels = self.planes.view(-1, self.planes.shape[-1])
        return (samples @ texels).view(-1, self.features)
