"""The centre: takes what rigs push, keeps it whole, and shows it. It tells no rig what to do."""
