"""`leco stability`: small scenes and disturbances in which samplers fail, and who fails in them."""
