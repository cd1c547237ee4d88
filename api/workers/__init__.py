"""Long work in processes of its own: started, told what to do, cancelled."""
