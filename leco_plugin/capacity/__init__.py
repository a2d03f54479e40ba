"""`leco capacity`: how much does this scene need?"""
