"""The centre: takes what rigs push, keeps it whole, and shows it. It asks nothing of a rig and tells it nothing to do."""
