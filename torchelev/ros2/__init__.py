"""The map as a ROS 2 node: clouds and tf in, GridMap, costmap and height scans out. `torchelev ros2 --config FILE`.

`settings` are the parameters, `intake` decides which clouds are fused and when, `engines` are the maps (PyTorch's, or
the C library, without PyTorch), `outputs` what is published, `node` the glue to rclpy: it alone imports ROS.
"""
