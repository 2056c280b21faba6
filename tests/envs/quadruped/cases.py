"""What the tests of the quadruped share: small terrains."""

from envs.quadruped.config import QuadrupedConfig, SightConfig, TerrainConfig

SMALL = TerrainConfig(kinds=("flat", "stairs_up"), num_levels=2, length=6.0, rim=0.3)
FLAT = TerrainConfig(kinds=("flat",), num_levels=1, length=6.0, rim=0.3)
SIGHT = SightConfig(camera_pixels=(12, 8))
CFG = QuadrupedConfig(terrain=SMALL, sight=SIGHT)
FLAT_CFG = QuadrupedConfig(terrain=FLAT, sight=SIGHT)
