/* Racing line and weights from the FMU's resources folder. Both files are little-endian, begin with
 * a head of 32 bytes and end exactly where it says:
 *
 *   0   magic, 8 bytes: "BRFMPATH" or "BRFMGPWT"
 *   8   schema, u32: 1
 *   12  body's length in bytes, u32
 *   16  FNV-1a hash (64 bit) of the body, u64
 *   24  training points per output that the controller has room for, u64: for tools, not read here
 *
 * Body of path.bin: spacing [m] f64, then rows of BR_PATH_COLUMNS f64, see br_mpc_set_path.
 * Body of weights.bin: identity of the discretised model, 256 bytes, zero padded; for each of the
 * BR_NE outputs kernel u32, points n u32, offset f64, scale f64, BR_NZ length scales f64, inputs
 * n x BR_NZ f64, alpha n f64, see br_mpc_gp.
 *
 * Whatever a file holds, nothing is read beyond it.
 */
#ifndef CONTROLLER_RESOURCES_H
#define CONTROLLER_RESOURCES_H

#include "bayesrace_mpc.h"

#define RESOURCE_PATH "path.bin"
#define RESOURCE_WEIGHTS "weights.bin"
#define RESOURCE_IDENTITY_BYTES 256

/* Loads both files of the folder into mpc. 0, or -1 and a sentence in text. identity: of the model
 * that mpc predicts with; weights for another one are refused. */
int resources_load(br_mpc *mpc, const char *folder, const char *identity, char *text, size_t size);

#endif
