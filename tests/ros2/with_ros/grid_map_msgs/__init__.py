"""grid_map_msgs for the tests: the wheel isaacsim-ros2 has none, nor the headers to compile one."""
