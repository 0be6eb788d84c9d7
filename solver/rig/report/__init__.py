"""The certificate of a rig: its figures, what they are judged by, and what is told of them."""
