"""spadmnist: what a single-photon camera would have recorded."""
