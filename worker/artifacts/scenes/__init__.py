"""Writers of the moving mesh for programs that edit scenes: USD, Alembic, MDD."""
