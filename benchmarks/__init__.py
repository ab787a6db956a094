"""Programs that run algorithms on tasks and compare them. They meet only in files, and use public names of sb3_gac."""
