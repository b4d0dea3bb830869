"""Who computes views, where that is more than one device. Begin with pool.py and parts.py.

- pool.py says what a pool of workers is: each has a device, and can be lost; it shares views out;
- parts.py has a work's parts, made on the workers, told what changes, and made again elsewhere when a worker is lost;
- helping.py goes on without them where all are lost and the master can do their work;
- host.py is the pool of several devices of this computer, cluster.py that of a Dask cluster, whose workers hold their
  parts as actor.py says; client.py asks them for a sign of life.
"""
