"""Where a camera can be: by a mesh, by depth images, by photographs."""
