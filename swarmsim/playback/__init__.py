"""What a flown mission looks like: the Rerun recording, the figures, and the viewer that opens them."""
