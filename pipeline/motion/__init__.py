"""Motion capture: reading BVH (``bvh``), and carrying it over to the body's joints (``retarget``)."""
