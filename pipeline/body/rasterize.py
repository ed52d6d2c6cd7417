"""The mesh rasterizer of a CPU: the point of a mesh that each pixel sees, and a shaded picture of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pipeline.body.mesh import face_normals, vertex_normals
from pipeline.clip.camera import Camera, project, to_camera
from pipeline.numba_kernels import exact_kernel

_NEAREST = 0.01  # metres; triangles that reach nearer to the camera are not drawn


@dataclasses.dataclass(frozen=True)
class Raster:
    """The point of a mesh that each pixel sees.

    Attributes:
        face: [H, W] int32, -1 where there is none.
        barycentrics: [H, W, 3] float32, on that face, perspective-correct; zero where there is none.
        depth: [H, W] float32, metres along the camera's Z; infinite where there is none.
    """

    face: np.ndarray
    barycentrics: np.ndarray
    depth: np.ndarray

    @property
    def covered(self) -> np.ndarray:
        """[H, W] bool, true where the pixel sees the mesh."""
        return self.face >= 0

    def interpolate(self, faces: np.ndarray, attribute: np.ndarray) -> np.ndarray:
        """A vertex attribute seen through the pixels: [V, C] -> [H, W, C], zero off the mesh."""
        picture = np.zeros((*self.face.shape, attribute.shape[1]), np.float32)
        values = np.ascontiguousarray(attribute, np.float32)
        _interpolate(self.face, self.barycentrics, faces, values, picture)
        return picture


def rasterize(camera: Camera, vertices: Tensor, faces: Tensor) -> Raster:
    """Find the nearest face under the centre of each pixel; both sides of a face count.

    Not differentiable. Triangles that come nearer than 1 cm to the camera, or that lie behind it,
    are left out.

    Args:
        camera: the view.
        vertices: [V, 3], metres, in the world.
        faces: [F, 3] int64.

    >>> from pipeline.clip.camera import facing_camera
    >>> triangle = torch.tensor([[-1.0, -1, -2], [1, -1, -2], [0, 1, -2]])
    >>> raster = rasterize(facing_camera(8, 8, focal=8.0), triangle, torch.tensor([[0, 1, 2]]))
    >>> bool(raster.covered[4, 4]), float(raster.depth[4, 4])
    (True, 2.0)
    """
    with torch.no_grad():
        pixels = project(camera, vertices).cpu().numpy().astype(np.float32)
        depth = to_camera(camera, vertices)[:, 2].cpu().numpy().astype(np.float32)
    size = (camera.height, camera.width)
    raster = Raster(
        np.full(size, -1, np.int32), np.zeros((*size, 3), np.float32), np.full(size, np.inf, np.float32)
    )
    usable = np.isfinite(pixels).all(1) & (depth > _NEAREST)
    _rasterize(pixels, depth, usable, faces.cpu().numpy(), raster.face, raster.barycentrics, raster.depth)
    return raster


def draw_mesh(
    image: np.ndarray,  # [H, W, 3] uint8
    camera: Camera,
    vertices: Tensor,  # [V, 3]
    faces: Tensor,  # [F, 3]
    color: tuple[int, int, int] | np.ndarray = (170, 190, 235),
    opacity: float = 1.0,
    smooth: bool = True,
) -> np.ndarray:
    """A picture with a Lambert-shaded mesh drawn over it; the light stands beside the camera.

    Args:
        image: RGB, of the camera's size; not changed.
        camera: the view.
        vertices: metres, in the world.
        faces: int64.
        color: RGB in 0..255, one for all or [V, 3].
        opacity: of the mesh over the image, 0 to 1.
        smooth: shade by vertex normals; else each face is flat.

    Returns:
        [H, W, 3] uint8.
    """
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(f"image is {image.shape[:2]}, the camera {(camera.height, camera.width)}")
    raster = rasterize(camera, vertices, faces)
    corners = faces.cpu().numpy()
    colors = np.broadcast_to(np.asarray(color, np.float32), (len(vertices), 3))
    with torch.no_grad():
        if smooth:
            light = _lambert(camera, vertex_normals(vertices, faces))
            shaded = raster.interpolate(corners, colors * light[:, None])
        else:
            light = _lambert(camera, torch.nn.functional.normalize(face_normals(vertices, faces), dim=-1))
            shaded = raster.interpolate(corners, colors) * light[raster.face][..., None]
    drawn = image.copy()
    on = raster.covered
    drawn[on] = np.clip((1 - opacity) * image[on] + opacity * shaded[on] + 0.5, 0, 255).astype(np.uint8)
    return drawn


def _lambert(camera: Camera, normals: Tensor) -> np.ndarray:
    """Brightness 0.2 to 1 by unit normals in the world: [N, 3] -> [N]."""
    towards = normals.new_tensor([-0.35, -0.45, -0.82])  # from the surface up, left and to the camera
    towards = camera.rotation.to(normals).mT @ (towards / towards.norm())
    return (0.2 + 0.8 * (normals @ towards).abs()).cpu().numpy().astype(np.float32)


@exact_kernel
def _rasterize(pixels, depth, usable, faces, face_out, barycentrics_out, depth_out):  # pragma: no cover
    """Fill the three pictures; loops over faces, then over the pixels of each one's box."""
    height, width = face_out.shape
    for k in range(faces.shape[0]):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        if not (usable[a] and usable[b] and usable[c]):
            continue
        ax, ay = pixels[a, 0], pixels[a, 1]
        bx, by = pixels[b, 0], pixels[b, 1]
        cx, cy = pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0:
            continue
        left, right = max(0.0, min(ax, bx, cx)), min(float(width), max(ax, bx, cx))
        top, bottom = max(0.0, min(ay, by, cy)), min(float(height), max(ay, by, cy))
        if left >= right or top >= bottom:
            continue
        inverse = 1 / area
        for y in range(int(top), min(height, int(bottom) + 1)):
            for x in range(int(left), min(width, int(right) + 1)):
                px, py = x + 0.5, y + 0.5
                v = ((px - ax) * (cy - ay) - (cx - ax) * (py - ay)) * inverse
                w = ((bx - ax) * (py - ay) - (px - ax) * (by - ay)) * inverse
                u = 1 - v - w
                if u < 0 or v < 0 or w < 0:
                    continue
                u, v, w = u / depth[a], v / depth[b], w / depth[c]  # 1/z is linear on the screen
                z = 1 / (u + v + w)
                if z < depth_out[y, x]:
                    depth_out[y, x] = z
                    face_out[y, x] = k
                    barycentrics_out[y, x, 0] = u * z
                    barycentrics_out[y, x, 1] = v * z
                    barycentrics_out[y, x, 2] = w * z


@exact_kernel
def _interpolate(face, barycentrics, faces, attribute, out):  # pragma: no cover
    height, width = face.shape
    for y in range(height):
        for x in range(width):
            k = face[y, x]
            if k < 0:
                continue
            for channel in range(attribute.shape[1]):
                total = np.float32(0)
                for corner in range(3):
                    total += barycentrics[y, x, corner] * attribute[faces[k, corner], channel]
                out[y, x, channel] = total
