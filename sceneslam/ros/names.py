"""Topic and frame names of SceneSLAM's recordings (REP-103, REP-105)."""

from __future__ import annotations

MAP, ODOM, BASE, GT = "map", "odom", "base_link", "gt"
CAMERA, LASER, LIDAR = "camera_color_optical_frame", "laser", "lidar"

IMAGE = "/camera/color/image/compressed"
CAMERA_INFO = "/camera/color/camera_info"
DEPTH = "/camera/depth/image/compressed"
SCAN = "/scan"
POINTS = "/points"
ODOMETRY = "/odom"
IMU = "/imu"
TF = "/tf"
TF_STATIC = "/tf_static"
TRUTH_ODOMETRY = "/ground_truth/odom"
TRUTH_SCENE = "/ground_truth/scene"
OWN_PREFIX = "/sceneslam/"  # results, never an input
RESULT_ODOMETRY = OWN_PREFIX + "odometry"
RESULT_PATH = OWN_PREFIX + "path"
RESULT_POINTS = OWN_PREFIX + "points"
RESULT_MAP = "/map"
RESULT_MODULE = OWN_PREFIX + "module"
RESULT_EVENTS = OWN_PREFIX + "events"  # JSON

RIG_METADATA = "sceneslam.rig"  # MCAP metadata: properties of a rig that no ROS message has

TYPES = {
    IMAGE: "sensor_msgs/msg/CompressedImage",
    CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    DEPTH: "sensor_msgs/msg/CompressedImage",
    SCAN: "sensor_msgs/msg/LaserScan",
    POINTS: "sensor_msgs/msg/PointCloud2",
    ODOMETRY: "nav_msgs/msg/Odometry",
    IMU: "sensor_msgs/msg/Imu",
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
    TRUTH_ODOMETRY: "nav_msgs/msg/Odometry",
    TRUTH_SCENE: "std_msgs/msg/String",
    RESULT_ODOMETRY: "nav_msgs/msg/Odometry",
    RESULT_PATH: "nav_msgs/msg/Path",
    RESULT_POINTS: "sensor_msgs/msg/PointCloud2",
    RESULT_MAP: "nav_msgs/msg/OccupancyGrid",
    RESULT_MODULE: "std_msgs/msg/String",
    RESULT_EVENTS: "std_msgs/msg/String",
}
