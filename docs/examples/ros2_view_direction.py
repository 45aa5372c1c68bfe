"""A ROS 2 node that says where to point the camera: from the robot's pose to a view direction.

    pip install numpy onnxruntime
    wheretolook export --map SPARSE --mesh MESH --out robot     # on any machine, once
    PYTHONPATH=robot python3 ros2_view_direction.py --ros-args -p folder:=robot -r '~/pose:=/camera_pose'

It subscribes to `~/pose` (geometry_msgs/PoseStamped): where the camera is, in the map's frame; its orientation does not
matter. For each pose it publishes the best view at that place:

    ~/view       geometry_msgs/PoseStamped: the same place, with the orientation of the camera's optical frame
                 (z forward, x right, y down) in the map's frame
    ~/direction  geometry_msgs/Vector3Stamped: the unit vector to look along, in the map's frame

Parameters: `folder`, what `wheretolook export` wrote; `frame`, the map's ("map"); `directions` that are compared (200);
`min_pitch_deg` and `max_pitch_deg` (-30 and 30), up from level; `min_score` (0.0), below which nothing is published.

The map's frame must be that of the COLMAP model: metres, z up. This is an example to start from. It was checked by a
parser against wheretolook_robot.py, but not run under ROS here.
"""

import rclpy
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from rclpy.node import Node
from wheretolook_robot import RobotScorer


class ViewDirection(Node):
    """Publishes where to look from each pose that arrives."""

    def __init__(self) -> None:
        super().__init__("view_direction")
        self.frame = self.declare_parameter("frame", "map").value
        self.directions = self.declare_parameter("directions", 200).value
        low = self.declare_parameter("min_pitch_deg", -30.0).value
        high = self.declare_parameter("max_pitch_deg", 30.0).value
        self.pitch_deg = (low, high)
        self.min_score = self.declare_parameter("min_score", 0.0).value
        self.scorer = RobotScorer(self.declare_parameter("folder", "robot").value)
        self.view_publisher = self.create_publisher(PoseStamped, "~/view", 1)
        self.direction_publisher = self.create_publisher(Vector3Stamped, "~/direction", 1)
        # of poses that arrive while a view is searched for, only the last one counts
        self.create_subscription(PoseStamped, "~/pose", self.on_pose, 1)

    def on_pose(self, message: PoseStamped) -> None:
        """Publish the best view from where the pose is."""
        if message.header.frame_id != self.frame:
            text = f"a pose in {message.header.frame_id!r}, not in the map's frame {self.frame!r}, is left out"
            self.get_logger().warning(text, throttle_duration_sec=5.0)
            return
        at = message.pose.position
        view = self.scorer.best((at.x, at.y, at.z), directions=self.directions, pitch_deg=self.pitch_deg)
        if view.score < self.min_score:
            self.get_logger().warning(f"no view here is sure: {view.score:.2f}", throttle_duration_sec=5.0)
            return
        if not view.in_range:
            self.get_logger().warning("views here are unlike those learnt from", throttle_duration_sec=5.0)
        found = PoseStamped(header=message.header)
        found.pose.position = at
        x, y, z, w = (float(value) for value in view.quaternion_xyzw)
        orientation = found.pose.orientation
        orientation.x, orientation.y, orientation.z, orientation.w = x, y, z, w
        self.view_publisher.publish(found)
        direction = Vector3Stamped(header=message.header)
        direction.vector.x, direction.vector.y, direction.vector.z = (float(value) for value in view.direction)
        self.direction_publisher.publish(direction)


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = ViewDirection()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
