"""ROS messages as SceneSLAM reads and writes them."""
