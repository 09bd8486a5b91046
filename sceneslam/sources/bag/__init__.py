"""Recordings of ROS messages: their files, topics, sensors and truth."""
