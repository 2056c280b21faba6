"""Files of robot models for `torchelev.io.robot_model`: URDF as robots ship it, its meshes, and which shapes count."""
