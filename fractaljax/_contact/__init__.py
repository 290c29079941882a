"""Contact laws: from a surface, a material and a load to the stiffness of a joint."""
