"""Fuse an RGB-D recording to a mesh, upright, in metres."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.graph import connected_component_labels

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float
from wheretolook.geometry.similarity import Similarity
from wheretolook.geometry.tsdf import TsdfConfig, TsdfVolume
from wheretolook.mapping.colmap_model import write_model
from wheretolook.mapping.gravity import estimate_gravity, rotation_to_z
from wheretolook.scans.checks import check_depth_unit, landmark_readings
from wheretolook.scans.config import RgbdConfig
from wheretolook.scans.depth_correction import fit_depth_correction
from wheretolook.scans.frames import RgbdFrames
from wheretolook.scans.textures import textured
from wheretolook.utils.errors import MapWarning, SceneError

TRUNCATION_VOXELS = 4.0  # behind a surface that count as inside it: 4 cm cover the noise of depth and poses
_MIN_READINGS = 3.0  # of a voxel that is part of the surface
_MIN_PIECE_M2 = 0.01  # smaller disconnected pieces are noise
_ROUNDS_DEG = (45.0,) * 5 + (15.0,) * 5  # of the refinement of up: largest angle of a level or upright surface to it
_IS_Z_DEG = 3.0  # a world this close to upright counts as upright
_DISAGREE_DEG = 30.0  # between the given and the estimated direction up


@dataclass(frozen=True, eq=False)
class Scan:
    """The mesh of a recording and its frames."""

    mesh: TexturedMesh  # metres, z up
    frames: RgbdFrames
    up: Float  # (3,) unit, up in the recording's world, or the model's
    rotation: Float  # (3, 3) from that world to the upright one

    def describe(self) -> list[str]:
        """Sentences about frames used and skipped, the unit of depth, and up."""
        frames = self.frames
        skipped = ", ".join(f"{number} {reason}" for reason, number in frames.skipped.items())
        used = f"{len(frames)} frames of a recording of {frames.layout.name}'s layout"
        lines = [
            f"{used}; not used: {skipped}" if skipped else used,
            f"{frames.depth_scale:g} units of depth a metre; up is ({_rounded(self.up)}) in the recording's world, z here",
        ]
        if frames.model is not None:
            lines.append(f"depths corrected by the model's landmarks: {frames.depth_correction.describe()}")
        return lines

    def report(self) -> dict[str, Any]:
        """Properties of the scan as values of JSON."""
        frames = self.frames
        return {
            "layout": frames.layout.name,
            "n_frames": len(frames),
            "skipped": dict(frames.skipped),
            "depth_scale": frames.depth_scale,
            "depth_correction": asdict(frames.depth_correction),
            "up": self.up.tolist(),
            "rotation": self.rotation.tolist(),
            "n_triangles": len(self.mesh.triangles),
            "n_textures": len(self.mesh.textures),
            "camera": frames.camera.record(),
        }

    def save_model(self, folder: Path) -> None:
        """Write the frames as a COLMAP model in the mesh's world: cameras, poses and names, and a given model's points.

        With it, `wheretolook map --model` maps the colour images in the frame of this mesh.
        """
        import pycolmap

        model = self.frames.model
        if model is not None:
            model = pycolmap.Reconstruction(model)
            Similarity(1.0, self.rotation, np.zeros(3)).transform_model(model)
        else:
            model = pycolmap.Reconstruction()
            model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **self.frames.camera.colmap.record()))
            for number, (name, pose) in enumerate(zip(self.frames.names, self.frames.cam_from_world, strict=True), 1):
                turned = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3] @ self.rotation.T), pose[:, 3])
                model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=number), turned)
        write_model(model, folder)


def make_scan(config: RgbdConfig, device: str = "cpu") -> Scan:
    """Read, check and fuse the recording in `config.folder`.

    Issues a `MapWarning` if the given direction up seems wrong. Raises SceneError if the recording is incomplete, its
    depths are in another unit, or show no surface; MapError if the model cannot be read; ConfigError if the voxels do
    not fit into memory.
    """
    frames = RgbdFrames(config)
    check_depth_unit(frames)
    if frames.model is not None and config.correct_depth:
        correction = fit_depth_correction(*landmark_readings(frames, frames.model).T)
        if correction is not None:
            frames.correct_depths(correction)
    tsdf = TsdfConfig(config.voxel_m, TRUNCATION_VOXELS, config.max_depth_m)
    volume = TsdfVolume.from_images(frames, tsdf, colored=True)
    mesh = _without_small_pieces(volume.surface(min(_MIN_READINGS, len(frames))))
    del volume
    if config.appearance == "texture":
        mesh = textured(mesh, frames, device)
    up = _up(config, frames, mesh)
    rotation = rotation_to_z(up)
    turned = replace(mesh, vertices=(mesh.vertices @ rotation.T).astype(np.float32), origin=rotation @ mesh.origin)
    return Scan(turned, frames, up, rotation)


def _up(config: RgbdConfig, frames: RgbdFrames, mesh: TexturedMesh) -> Float:
    if config.up_direction is None:
        return find_up(frames.cam_from_world, mesh)
    up = np.asarray(config.up_direction, dtype=np.float64)
    up = up / np.linalg.norm(up)
    held = estimate_gravity(frames.cam_from_world).up
    off_deg = float(np.degrees(np.arccos(np.clip(up @ held, -1, 1))))
    if off_deg > _DISAGREE_DEG:
        text = f"{frames.folder}: up is given as {config.up}, but as the camera was held it is ({_rounded(held)}), "
        text += f"{off_deg:.0f} degrees from it. --scenes.rgbd.up auto estimates it"
        warnings.warn(text, MapWarning, stacklevel=3)
    return up


def find_up(cam_from_world: Float, mesh: TexturedMesh) -> Float:
    """Estimate the unit direction up (3,) in the frame of poses (F, 3, 4) and of a mesh of the recording.

    Starts from `estimate_gravity`, then refines it by the mesh: floors and walls are perpendicular or parallel to up
    (Gupta, Arbelaez and Malik, "Perceptual Organization and Recognition of Indoor Scenes from RGB-D Images", CVPR
    2013), weighted by area. z itself if it is that to within 3 degrees.
    """
    up = estimate_gravity(cam_from_world).up
    normals = mesh.normals
    area = np.linalg.norm(normals, axis=1)
    units = normals / np.maximum(area, 1e-12)[:, None]
    for limit_deg in _ROUNDS_DEG:
        along = units @ up
        level = np.abs(along) > np.cos(np.radians(limit_deg))
        upright = np.abs(along) < np.sin(np.radians(limit_deg))
        scatter = _scatter(units[upright], area[upright]) - _scatter(units[level], area[level])
        found = np.linalg.eigh(scatter)[1][:, 0]
        up = found if found @ up > 0 else -found
    return np.array([0.0, 0.0, 1.0]) if up[2] > np.cos(np.radians(_IS_Z_DEG)) else np.asarray(up)


def _scatter(units: Float, weights: Float) -> Float:
    return np.asarray((units.T * weights) @ units)


def _rounded(direction: Float) -> str:
    return " ".join(f"{value:.2f}" for value in np.round(direction, 2) + 0.0)


def _without_small_pieces(mesh: TexturedMesh) -> TexturedMesh:
    """Remove small disconnected pieces of a mesh, and unused vertices."""
    edges = np.concatenate([mesh.triangles[:, :2], mesh.triangles[:, 1:]])
    piece = connected_component_labels(edges, len(mesh.vertices))
    piece_of = piece[mesh.triangles[:, 0]]
    area_m2 = np.bincount(piece_of, np.linalg.norm(mesh.normals, axis=1) / 2)
    keep = area_m2[piece_of] >= _MIN_PIECE_M2
    if not keep.any():
        fix = "Check the poses, and that depths are in metres."
        raise SceneError("the depth images show no connected surface", value=f"{area_m2.max():.2g} m2", fix=fix)
    return mesh.only(keep)
