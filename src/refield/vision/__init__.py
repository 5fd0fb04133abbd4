"""What we borrow from 2-D vision. Imports nothing of ours."""
