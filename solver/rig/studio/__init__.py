"""The light rig that a studio ships: a person's own 52 shapes, joints, and parts with materials."""
