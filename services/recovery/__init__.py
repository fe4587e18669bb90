"""What a stage does about an output that a detector finds wrong."""
