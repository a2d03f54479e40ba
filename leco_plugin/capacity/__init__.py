"""`leco shrink` and `leco capacity`: how small may an occupancy be?"""
