"""A drive that says nothing by itself: one frame asks for registers, one answers, one commands a torque."""
