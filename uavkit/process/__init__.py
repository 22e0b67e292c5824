"""From a block to oriented images and object points."""
