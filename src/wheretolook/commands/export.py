"""`wheretolook export`: a map and the weights as a robot needs them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from wheretolook.commands.options import CameraOptions, MeshOptions
from wheretolook.dataset.config import checked_accuracy
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.looks.next_look import mean_scores_by_pitch
from wheretolook.mapping.config import FrameOptions
from wheretolook.scorers.weights import load_scorer, resolve_weights
from wheretolook.select.waypoints import grid_waypoints
from wheretolook.utils.errors import ConfigError, check_positive

MAX_LOCATIONS = 20_000


@dataclass(frozen=True, kw_only=True)
class Export(CameraOptions, MeshOptions, FrameOptions):
    """Export what a robot needs to score views of a map with NumPy and onnxruntime, without PyTorch.

    The folder then holds the network (scorer.onnx), the landmarks (landmarks.npz), the camera (robot.json), and
    wheretolook_robot.py, which reads and explains them. Copy it to the robot; `pip install numpy onnxruntime` there.

    A robot has no mesh. With --mesh, the visible landmarks of each free location of a grid are stored, and the robot
    uses those of the nearest location; without, it sees landmarks through walls. By default the robot's camera is the
    map's own, if it has but one, as the pinhole of its rectified images.

    Examples:
      wheretolook export --map sparse/0 --mesh house.glb --spacing 0.5 --out robot
      cd robot && python -c "from wheretolook_robot import RobotScorer; print(RobotScorer('.').best((1, 2, 1.5)))"

    Args:
        map: folder of a COLMAP model; the robot gives and gets positions in its own frame and unit.
        out: folder to write.
        weights: file of weights of the method set; by default the bundled ones for the features of the map.
        database: the map's database, as of `wheretolook select`.
        spacing: of the grid, in metres.
        accuracy: limits of the errors in metres and degrees that scores refer to; by default those of the weights,
            0.05,0.4. In a map of unknown unit, metres are those of a median depth of 5 m.
        localize: also write the SIFT descriptors and the package wheretolook_localization, which localizes views and
            selects the next with NumPy, SciPy and PoseLib.
    """

    WRITES: ClassVar = "robot.json"

    map: Path
    out: Path
    weights: Path | None = None
    database: Path | None = None
    spacing: float = 0.5
    accuracy: tuple[float, float] | None = None
    localize: bool = False

    def __post_init__(self) -> None:
        check_positive("spacing", self.spacing)
        if self.accuracy is not None:
            checked_accuracy(self.accuracy)
        self.frame_options()
        self.named_camera()

    def run(self) -> None:
        """Write the robot's folder."""
        from wheretolook.robot.export import export_robot, pinhole_of

        files = ColmapFiles(
            self.map, mesh=self.mesh, mesh_up=self.mesh_up, database=self.database, frame=self.frame_options()
        )
        occlusion = "none" if self.mesh is None else "mesh"
        scene = Scene.of_colmap(files, self.named_camera(), occlusion)
        source = scene.localization_map
        locations = None
        if self.mesh is not None:
            locations = grid_waypoints(source, scene.mesh_space, self.spacing).points
            if len(locations) > MAX_LOCATIONS:
                problem = f"the grid has {len(locations):,} free locations, more than {MAX_LOCATIONS:,}"
                raise ConfigError(problem, value=self.spacing, fix="Give a larger --spacing.")
        camera = pinhole_of(source.camera)
        if camera != source.camera:
            print("the map's camera has distortion, the robot's is the pinhole of its rectified images")
        weights = resolve_weights("set", self.weights, source.landmarks.features)
        assert weights is not None
        if self.localize:
            from wheretolook.robot.export import export_localizer
            from wheretolook.select.image_localizer import ImageLocalizer

            described = ImageLocalizer.open(self.map, self.database, self.frame_options()).landmarks
            scorer = load_scorer(source.of_camera(camera), weights)
            if self.accuracy is not None:
                scorer = scorer.at_accuracy(self.accuracy)
            export_localizer(described, source.landmarks.ids, mean_scores_by_pitch(scorer), self.out)
        export_robot(source.of_camera(camera), weights, self.out, locations, accuracy=self.accuracy)
        print(source.frame.describe())
        print(f"{len(source.landmarks):,} landmarks, a camera of {camera.width} x {camera.height} px: {self.out}")
        if locations is None:
            print("without --mesh the robot sees landmarks through walls")
        else:
            print(f"visible landmarks are stored for {len(locations):,} free locations, {self.spacing:g} m apart")
