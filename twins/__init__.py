"""Bodies that are simulated: row-wise models of the robots and what nature adds to them."""
