declare module "swagger-ui-dist/swagger-ui-bundle.js" {
  const SwaggerUI: (options: Record<string, unknown>) => unknown;
  export default SwaggerUI;
}
declare module "*.css";
