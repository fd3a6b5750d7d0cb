"""Physics: rotations, vehicles and the equations of motion, for one vehicle at a time."""
