"""Reads depth images that belong to the images of a COLMAP model."""

from __future__ import annotations

from pathlib import Path

from wheretolook.geometry.camera import Camera, PinholeCamera, cameras_by_id
from wheretolook.geometry.tsdf import DepthImage
from wheretolook.io.depth import read_depth
from wheretolook.mapping.colmap_model import read_model
from wheretolook.utils.errors import SceneError
from wheretolook.utils.validation import check_positive


def read_depth_images(model: Path, folder: Path, scale: float = 1000.0) -> list[DepthImage]:
    """Read the depth images of a COLMAP model's images from a folder (see `read_depth` for formats and `scale`).

    A depth image has the name of its image, apart from the ending and with "depth" in place of "color" or "rgb" if
    need be. It is registered to the image and may have another size; the camera must have no distortion. Raises a
    SceneError if there are none or one cannot be read, a ConfigError if the camera has distortion.
    """
    check_positive("the number of units of depth images in a metre", scale)
    reconstruction = read_model(model)
    cameras = cameras_by_id(reconstruction.cameras, model)
    files = {p.relative_to(folder).with_suffix("").as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file()}
    images = []
    for _, image in sorted(reconstruction.images.items()):
        stem = Path(image.name).with_suffix("").as_posix()
        stems = [stem, *(stem.replace(word, "depth") for word in ("color", "colour", "rgb"))]
        path = next((files[name] for name in stems if name in files), None)
        if path is not None and image.has_pose:
            try:
                depth_m = read_depth(path, scale)
            except (OSError, ValueError) as error:
                problem = f"cannot read the depth image: {error}"
                raise SceneError(problem, path=path, fix="Export it again.") from error
            camera = _scaled(cameras[image.camera_id], depth_m.shape[1], depth_m.shape[0])
            images.append(DepthImage(depth_m, camera, image.cam_from_world().matrix()))
    if not images:
        fix = "Name each as its image, with the ending of a depth image, such as .png."
        raise SceneError("no depth image belongs to an image of the map", path=folder, fix=fix)
    return images


def _scaled(camera: Camera, width: int, height: int) -> PinholeCamera:
    """Scale a camera without distortion to another size."""
    across = width / camera.width
    down = height / camera.height
    ((fx, _, cx), (_, fy, cy), _) = camera.matrix.tolist()
    return PinholeCamera(width, height, fx * across, fy * down, (cx * across, cy * down))
