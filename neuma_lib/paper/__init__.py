"""Tables, claims and figures of the paper. Other rooms but the viewer do not need them."""
