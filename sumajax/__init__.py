"""Multi-agent reinforcement learning scaled by state upsampling, as one compiled JAX program."""
