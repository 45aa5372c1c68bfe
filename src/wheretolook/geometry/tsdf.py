"""Depth images fused into a truncated signed distance field (TSDF), and the surface that they show.

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996, in the hashed
blocks of voxels of Dong, Park, Yang and Kaess, "ASH", T-PAMI 2022 (Open3D's `VoxelBlockGrid`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, are_rotations, camera_centers, check_poses
from wheretolook.geometry.similarity import local_origin, poses_from
from wheretolook.utils.devices import fitting
from wheretolook.utils.errors import ConfigError, SceneError, check_positive

BLOCK_VOXELS = 8  # voxels along the side of a block
_TRUNCATION_VOXELS = 2.0
"""How far behind a surface space counts as inside it. The two faces of a wall thinner than twice this blur each other, so
it should be small; below about 1.5, gaps open."""


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image with its camera and pose.

    Raises a ConfigError if the image has another size than the camera or holds integers, the camera has distortion, or
    the pose is no rigid transform.
    """

    depth_m: NDArray[Any]  # (H, W) floats, metres along the optical axis; 0, negative, NaN and infinite mean no reading
    camera: Camera  # intrinsics: a pinhole, or a COLMAP camera of the model SIMPLE_PINHOLE or PINHOLE
    cam_from_world: Float  # (3, 4)

    def __post_init__(self) -> None:
        _ = self.camera.matrix  # raises if the camera has distortion
        size = (self.camera.height, self.camera.width)
        if np.shape(self.depth_m) != size:
            problem = f"a depth image must have the size of its camera, {size} (height, width)"
            raise ConfigError(problem, value=np.shape(self.depth_m))
        dtype = np.asarray(self.depth_m).dtype
        if not np.issubdtype(dtype, np.floating):
            fix = "Divide a 16-bit image by its depth scale, mostly 1000 a metre."
            raise ConfigError("a depth image must hold floats, in metres", value=str(dtype), fix=fix)
        rotation = check_poses([self.cam_from_world])[0, :, :3]
        if not are_rotations(rotation, 1e-3):
            raise ConfigError("cam_from_world of a depth image must hold a rotation", value=rotation.tolist())

    def readings(self, max_depth_m: float, stride: int = 1) -> NDArray[np.float32]:
        """Every stride-th pixel in both directions, float32, 0 where there is no reading up to `max_depth_m`."""
        depth = np.asarray(self.depth_m, dtype=np.float32)[::stride, ::stride]
        with np.errstate(invalid="ignore"):
            return np.where((depth > 0) & (depth <= max_depth_m), depth, np.float32(0))

    def points(self, max_depth_m: float, stride: int = 1) -> NDArray[np.float64]:
        """World coordinates (N, 3) m of the readings."""
        depth = self.readings(max_depth_m, stride)
        row, column = np.nonzero(depth)
        z = depth[row, column].astype(np.float64)
        pixels = np.column_stack([column * stride + 0.5, row * stride + 0.5, np.ones(len(z))])
        in_camera = pixels @ np.linalg.inv(self.camera.matrix).T * z[:, None]
        pose = np.asarray(self.cam_from_world, dtype=np.float64)
        return (in_camera - pose[:, 3]) @ pose[:, :3]


class DepthImages(Protocol):
    """Depth images by index; each may be read from disk or rendered when it is asked for."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> DepthImage: ...


class TsdfVolume:
    """A truncated signed distance field in hashed blocks of voxels, on the CPU.

    Use `from_images` where all images are at hand: it also checks the memory beforehand.

    Args:
        voxel_size_m: distance between two samples of the distance field. At 2 cm, precision and recall against a mesh
            were 0.97 to 0.997, at 1 cm 0.98 and more. What is thinner than about two voxels is rounded off or lost.
        max_depth_m: farther readings are left out, as those of most depth cameras are too noisy there.
        expected_blocks: room at the start; when it is used up, all blocks are copied to more.
        origin: (3,) m, about which Open3D computes in single precision.

    Raises:
        ConfigError: the voxel size or the depth is not positive and finite.
    """

    def __init__(
        self,
        voxel_size_m: float = 0.02,
        max_depth_m: float = 10.0,
        expected_blocks: int = 1 << 13,
        origin: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        import open3d as o3d

        check_positive("tsdf.voxel_size_m", voxel_size_m)
        check_positive("tsdf.max_depth_m", max_depth_m)
        self.voxel_size_m = voxel_size_m
        self.max_depth_m = max_depth_m
        self.origin = np.asarray(origin, dtype=np.float64)
        self._max_blocks = _max_blocks()
        self._grid: Any = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"),
            (o3d.core.float32, o3d.core.float32),
            [o3d.core.SizeVector([1]), o3d.core.SizeVector([1])],
            voxel_size_m,
            BLOCK_VOXELS,
            expected_blocks,
        )

    @classmethod
    def from_images(
        cls, images: DepthImages, voxel_size_m: float = 0.02, max_depth_m: float = 10.0, progress: bool = True
    ) -> TsdfVolume:
        """Fuse depth images, in any order. A sequence that reads each from disk when asked for it keeps memory low.

        Raises a ConfigError if the voxels would not fit the memory (found before the fusion, from a sample of the
        images), a SceneError if there is no image, or none of the sampled ones has a reading.
        """
        n_blocks = estimate_blocks(images, voxel_size_m, max_depth_m)
        _check_memory(n_blocks, voxel_size_m, _max_blocks())
        volume = cls(voxel_size_m, max_depth_m, n_blocks, _origin_of(images))
        for i in tqdm(range(len(images)), desc="fuse depth", unit="image", disable=not progress):
            volume.integrate(images[i])
        return volume

    def __len__(self) -> int:
        """Number of blocks in use."""
        return int(self._grid.hashmap().size())

    def integrate(self, image: DepthImage) -> None:
        """Average a depth image into the field. Raises ConfigError if the volume has outgrown the memory."""
        import open3d as o3d

        tensor: Any = o3d.core.Tensor
        depth = image.readings(self.max_depth_m)
        rows, columns = (side // 4 * 4 for side in depth.shape)  # Open3D looks for blocks at every fourth pixel
        if not depth[:rows:4, :columns:4].any():
            return  # Open3D would raise
        pose = np.vstack([poses_from(image.cam_from_world, self.origin), (0, 0, 0, 1)])
        shown = o3d.t.geometry.Image(tensor(np.ascontiguousarray(depth)))
        view = {
            "intrinsic": tensor(image.camera.matrix),
            "extrinsic": tensor(pose),
            "depth_scale": 1.0,
            "depth_max": float(self.max_depth_m),
            "trunc_voxel_multiplier": _TRUNCATION_VOXELS,
        }
        blocks = self._grid.compute_unique_block_coordinates(shown, **view)
        self._grid.integrate(blocks, shown, **view)
        _check_memory(len(self), self.voxel_size_m, self._max_blocks)

    def surface(self) -> TexturedMesh:
        """The zero crossing as triangles, whose fronts face the cameras that saw them, of all voxels with a reading.

        Several threads extract the triangles, so their order may differ from run to run; the triangles do not. Raises
        SceneError if there is none.
        """
        fix = "Check the poses, that depths are in metres, and that voxel_size_m is below the scene's size."
        nothing = SceneError("the depth images show no surface", value=f"{len(self)} blocks of voxels", fix=fix)
        if len(self) == 0:
            raise nothing
        # Shifting the field moves the crossing outwards, towards the cameras.
        shift = 0.1 / _TRUNCATION_VOXELS  # averaging views at a slant rounds edges off by a tenth of a voxel
        values = self._grid.attribute("tsdf").numpy()  # shares its memory
        values -= shift
        try:
            mesh = self._grid.extract_triangle_mesh(0.5, -1)
        except RuntimeError:  # Open3D fails for a mesh without vertices
            raise nothing from None
        finally:
            values += shift
        if "indices" not in mesh.triangle or len(mesh.triangle.indices) == 0:
            raise nothing
        triangles = mesh.triangle.indices.numpy().astype(np.int32)
        uvs = np.broadcast_to(np.float32(0), (len(triangles), 3, 2))  # takes no memory
        texture = np.broadcast_to(np.int32(0), (len(triangles),))
        white = (np.full((1, 1, 3), 255, np.uint8),)
        return TexturedMesh(mesh.vertex.positions.numpy(), triangles, uvs, texture, white, origin=self.origin)


def estimate_blocks(images: DepthImages, voxel_size_m: float, max_depth_m: float) -> int:
    """Blocks of voxels that the images' surfaces will touch, from some pixels of up to 100; SceneError without any."""
    block_m = BLOCK_VOXELS * voxel_size_m
    cell_m = max(block_m, 0.16)  # pixels this sparse do not show smaller blocks
    cells = np.empty(0, dtype=np.int64)
    number = np.array([1, 1 << 21, 1 << 42])  # one number a cell sorts faster than three
    sampled = {int(i) for i in np.linspace(0, len(images) - 1, 100)} if len(images) else ()
    for image in (images[i] for i in sampled):
        stride = max(1, int(np.sqrt(np.size(image.depth_m) / 5000)))  # about 5,000 pixels of each
        points = image.points(max_depth_m, stride) - _origin_of(images)
        cells = np.union1d(cells, np.floor(points / cell_m).astype(np.int64) @ number)
    if len(cells) == 0:
        problem = f"no depth image has a reading up to {max_depth_m:g} m"
        fix = "Check that depths are in metres and that max_depth_m is large enough."
        raise SceneError(problem, value=f"{len(images)} images", fix=fix)
    # The number of blocks that a surface touches grows with its area.
    # Surfaces also touch neighbouring blocks: 1.3 to 1.7 were measured.
    return int(np.ceil(1.7 * len(cells) * (cell_m / block_m) ** 2))


def _origin_of(images: DepthImages) -> Float:
    """The local origin (3,) m of images of one scene, by the location of the first."""
    return local_origin(camera_centers(images[0].cam_from_world))


def _max_blocks() -> int:
    """Number of blocks that fit into 80 % of the available memory."""
    # The peak from fusion to ray casting was 19 to 23 KiB a block on three scenes; Open3D's extraction of triangles
    # numbers four entries of each voxel by 32 bits.
    return min(fitting(24 * 1024), 1 << 20)


def _check_memory(n_blocks: int, voxel_size_m: float, max_blocks: int) -> None:
    """Raise ConfigError if there are more blocks than fit."""
    if n_blocks > max_blocks:
        enough = voxel_size_m * np.sqrt(n_blocks / max(max_blocks, 1))
        problem = f"the depth images need {n_blocks:,} blocks of voxels, {max_blocks:,} fit into memory"
        fix = f"A voxel_size_m of {1.1 * enough:.2g} would fit."
        raise ConfigError(problem, value=f"voxel_size_m={voxel_size_m:g}", fix=fix)
