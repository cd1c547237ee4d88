"""The elbow and what moves it: `limb` puts a muscle into an arm, `movers` move it, `laws` say what its tissue does."""
