"""Virtual subjects with known truth, and the frames a dome and a probe would take of them."""
