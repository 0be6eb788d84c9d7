"""Live sessions: a performer's frames in, the face of a rig out within the frame's own time."""
